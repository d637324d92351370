// The update of jaxtri's pose filter as one would write it in C++: the measure of what it may cost.
//
// One pass of the default model with constant noise: constant velocity, transfer from two base frames, the second
// base pose considered, Joseph's form. Points lie by component, so that the compiler makes vectors of the loops.
// c++ -O3 -march=native -ffast-math -shared -fPIC reference.cpp

#include <algorithm>
#include <cmath>
#include <cstring>

namespace {

constexpr int D = 18, S = 12;                                                 // errors, and those of the two poses
constexpr int SUPPORT[S] = {0, 1, 2, 6, 7, 8, 12, 13, 14, 15, 16, 17};

using Vector = double[3];
using Matrix = double[3][3];
using Square = double[D][D];

void cross_matrix(const double* v, Matrix m) {
    const double entries[9] = {0, -v[2], v[1], v[2], 0, -v[0], -v[1], v[0], 0};
    std::memcpy(m, entries, sizeof(entries));
}

void multiply(const Matrix a, const Matrix b, Matrix c) {
    Matrix out;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) out[i][j] = a[i][0] * b[0][j] + a[i][1] * b[1][j] + a[i][2] * b[2][j];
    std::memcpy(c, out, sizeof(out));
}

// exp([v]x) and the left Jacobian.
void rotation(const double* v, Matrix R, Matrix J) {
    const double x = v[0] * v[0] + v[1] * v[1] + v[2] * v[2], a = std::sqrt(x);
    const bool small = x < 1e-6;
    const double s = small ? 1 - x / 6 * (1 - x / 20) : std::sin(a) / a;
    const double c = small ? 0.5 - x / 24 * (1 - x / 30) : (1 - std::cos(a)) / x;
    const double d = small ? 1. / 6 - x / 120 : (1 - s) / x;
    Matrix K, K2;
    cross_matrix(v, K);
    multiply(K, K, K2);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            R[i][j] = (i == j) + s * K[i][j] + c * K2[i][j];
            J[i][j] = (i == j) + c * K[i][j] + d * K2[i][j];
        }
}

// a += or = F P F' for an F that is the identity but for some blocks is not worth its own code: dense.
void sandwich(const Square F, Square P) {
    static thread_local Square FP;
    for (int i = 0; i < D; ++i) {
        double row[D] = {};
        for (int k = 0; k < D; ++k)
            for (int j = 0; j < D; ++j) row[j] += F[i][k] * P[k][j];
        std::memcpy(FP[i], row, sizeof(row));
    }
    for (int i = 0; i < D; ++i)
        for (int j = 0; j < D; ++j) {
            double sum = 0;
            for (int k = 0; k < D; ++k) sum += FP[i][k] * F[j][k];
            P[i][j] = sum;
        }
}

void identity(Square F) {
    std::memset(F, 0, sizeof(Square));
    for (int i = 0; i < D; ++i) F[i][i] = 1;
}

void put(Square F, int row, int column, const Matrix m) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) F[row + i][column + j] = m[i][j];
}

// Gaussian elimination with pivoting: m (S, S) and its k right sides b (S, k), in place.
template <int K>
void solve(double m[S][S], double b[S][K]) {
    for (int c = 0; c < S; ++c) {
        int best = c;
        for (int r = c + 1; r < S; ++r)
            if (std::fabs(m[r][c]) > std::fabs(m[best][c])) best = r;
        if (best != c) {
            std::swap_ranges(m[c], m[c] + S, m[best]);
            std::swap_ranges(b[c], b[c] + K, b[best]);
        }
        for (int r = c + 1; r < S; ++r) {
            const double f = m[r][c] / m[c][c];
            for (int j = c + 1; j < S; ++j) m[r][j] -= f * m[c][j];
            for (int j = 0; j < K; ++j) b[r][j] -= f * b[c][j];
        }
    }
    for (int c = S - 1; c >= 0; --c) {
        for (int j = 0; j < K; ++j) b[c][j] /= m[c][c];
        for (int r = 0; r < c; ++r)
            for (int j = 0; j < K; ++j) b[r][j] -= m[r][c] * b[c][j];
    }
}

}  // namespace

struct State {
    Vector T, v;
    Matrix R;
    Vector w, T2;
    Matrix R2;
    Square P;
};

// observed (frames, 2, n), base (4, n): x, y, x', y'; epipole of the start. What comes out: T (frames, 3), R (frames,
// 3, 3), P (frames, 18, 18). work holds (2 * 12 + 2) n numbers.
extern "C" void run(int frames, int n, const double* observed, const double* base, const double* epipole, double sigma,
                    double acceleration, double angular, State* state, double* T_out, double* R_out, double* P_out,
                    double* work) {
    State& s = *state;
    double* hx = work;
    double* hy = work + S * n;
    double* rx = work + 2 * S * n;
    double* ry = rx + n;
    static thread_local Square F;
    Matrix J;
    for (int frame = 0; frame < frames; ++frame) {
        // Predict.
        Matrix turn;
        rotation(s.w, turn, J);
        identity(F);
        for (int i = 0; i < 3; ++i) F[i][3 + i] = 1;
        put(F, 6, 6, turn);
        put(F, 6, 9, J);
        sandwich(F, s.P);
        for (int i = 0; i < 3; ++i) {
            s.T[i] += s.v[i];
            for (int half = 0; half < 2; ++half) {
                const double q = half ? angular * angular : acceleration * acceleration;
                const int p = 6 * half + i;
                s.P[p][p] += q / 4;
                s.P[p][p + 3] += q / 2;
                s.P[p + 3][p] += q / 2;
                s.P[p + 3][p + 3] += q;
            }
        }
        multiply(turn, s.R, s.R);

        // Linearise: h = pi(R u + lambda T), lambda = -(l . R2 u) / (l . T2).
        const double* z = observed + 2L * frame * n;
        double norm = 0;
        for (int i = 0; i < 3; ++i) norm += s.T2[i] * s.T2[i];
        Vector axis;
        for (int i = 0; i < 3; ++i) axis[i] = s.T2[i] / std::sqrt(norm);
        const State c = s;
#pragma GCC ivdep
        for (int i = 0; i < n; ++i) {
            const double x = base[i], y = base[n + i], x2 = base[2 * n + i], y2 = base[3 * n + i];
            const double ax = epipole[0] - x2 * epipole[2], ay = epipole[1] - y2 * epipole[2];
            const double over = 1 / std::sqrt(ax * ax + ay * ay);
            const double l0 = ax * over, l1 = ay * over, l2 = -(l0 * x2 + l1 * y2);
            const double a0 = c.R2[0][0] * x + c.R2[0][1] * y + c.R2[0][2];
            const double a1 = c.R2[1][0] * x + c.R2[1][1] * y + c.R2[1][2];
            const double a2 = c.R2[2][0] * x + c.R2[2][1] * y + c.R2[2][2];
            const double r0 = c.R[0][0] * x + c.R[0][1] * y + c.R[0][2];
            const double r1 = c.R[1][0] * x + c.R[1][1] * y + c.R[1][2];
            const double r2 = c.R[2][0] * x + c.R[2][1] * y + c.R[2][2];
            const double across = 1 / (l0 * c.T2[0] + l1 * c.T2[1] + l2 * c.T2[2]);
            const double lambda = -(l0 * a0 + l1 * a1 + l2 * a2) * across;
            const double X = r0 + lambda * c.T[0], Y = r1 + lambda * c.T[1], Z = r2 + lambda * c.T[2];
            const double w = 1 / Z, hu = X * w, hv = Y * w;
            rx[i] = z[i] - hu;
            ry[i] = z[n + i] - hv;
            // of T
            hx[i] = lambda * w, hy[i] = 0;
            hx[n + i] = 0, hy[n + i] = lambda * w;
            hx[2 * n + i] = -hu * lambda * w, hy[2 * n + i] = -hv * lambda * w;
            // of R: delta x r
            hx[3 * n + i] = -hu * r1 * w, hy[3 * n + i] = (-r2 - hv * r1) * w;
            hx[4 * n + i] = (r2 + hu * r0) * w, hy[4 * n + i] = hv * r0 * w;
            hx[5 * n + i] = -r1 * w, hy[5 * n + i] = r0 * w;
            // of lambda, by T2 (of constant length) and R2
            const double gu = (c.T[0] - hu * c.T[2]) * w * across, gv = (c.T[1] - hv * c.T[2]) * w * across;
            const double along = l0 * axis[0] + l1 * axis[1] + l2 * axis[2];
            const double t0 = -lambda * (l0 - along * axis[0]), t1 = -lambda * (l1 - along * axis[1]);
            const double t2 = -lambda * (l2 - along * axis[2]);
            const double q0 = a2 * l1 - a1 * l2, q1 = a0 * l2 - a2 * l0, q2 = a1 * l0 - a0 * l1;
            hx[6 * n + i] = gu * t0, hy[6 * n + i] = gv * t0;
            hx[7 * n + i] = gu * t1, hy[7 * n + i] = gv * t1;
            hx[8 * n + i] = gu * t2, hy[8 * n + i] = gv * t2;
            hx[9 * n + i] = gu * q0, hy[9 * n + i] = gv * q0;
            hx[10 * n + i] = gu * q1, hy[10 * n + i] = gv * q1;
            hx[11 * n + i] = gu * q2, hy[11 * n + i] = gv * q2;
        }

        // A = H' H / sigma^2 and b, in coordinates scaled by the prior's standard deviations.
        const double weight = 1 / (sigma * sigma);
        double sd[D], A[S][S], b[S];
        for (int i = 0; i < D; ++i) sd[i] = s.P[i][i] > 0 ? std::sqrt(s.P[i][i]) : 1;
        for (int i = 0; i < S; ++i) {
            const double *xi = hx + i * n, *yi = hy + i * n;
            double sum = 0;
            for (int k = 0; k < n; ++k) sum += xi[k] * rx[k] + yi[k] * ry[k];
            b[i] = sum * weight * sd[SUPPORT[i]];
            for (int j = i; j < S; ++j) {
                const double *xj = hx + j * n, *yj = hy + j * n;
                double total = 0;
                for (int k = 0; k < n; ++k) total += xi[k] * xj[k] + yi[k] * yj[k];
                A[i][j] = A[j][i] = total * weight * sd[SUPPORT[i]] * sd[SUPPORT[j]];
            }
        }
        static thread_local Square P, prior;
        std::memcpy(prior, s.P, sizeof(Square));
        for (int i = 0; i < D; ++i)
            for (int j = 0; j < D; ++j) P[i][j] = s.P[i][j] / (sd[i] * sd[j]);

        // G = P (I + A P)^-1 by its transpose (I + P A) G' = P of the support's rows; I - G A; Joseph's form.
        double M[S][S], Gt[S][D];
        for (int i = 0; i < S; ++i) {
            for (int j = 0; j < S; ++j) {
                double sum = i == j;
                for (int k = 0; k < S; ++k) sum += P[SUPPORT[i]][SUPPORT[k]] * A[k][j];
                M[i][j] = sum;
            }
            std::memcpy(Gt[i], P[SUPPORT[i]], sizeof(Gt[i]));
        }
        solve<D>(M, Gt);
        double GA[D][S] = {};
        double delta[D] = {};
        for (int k = 0; k < S; ++k)
            for (int i = 0; i < D; ++i) {
                delta[i] += Gt[k][i] * b[k];
                for (int j = 0; j < S; ++j) GA[i][j] += Gt[k][i] * A[k][j];
            }
        identity(F);
        for (int i = 0; i < D; ++i)
            for (int j = 0; j < S; ++j) F[i][SUPPORT[j]] -= GA[i][j];
        sandwich(F, P);
        for (int i = 0; i < D; ++i)
            for (int k = 0; k < S; ++k)
                for (int j = 0; j < D; ++j) P[i][j] += GA[i][k] * Gt[k][j];
        for (int i = 0; i < D; ++i)
            for (int j = 0; j < D; ++j)
                s.P[i][j] = i >= 12 && j >= 12 ? prior[i][j] : (P[i][j] + P[j][i]) / 2 * sd[i] * sd[j];

        // Correct the mean, all but what is considered, and move the errors there.
        for (int i = 0; i < D; ++i) delta[i] *= i < 12 ? sd[i] : 0;
        Matrix moved;
        rotation(delta + 6, moved, J);
        multiply(moved, s.R, s.R);
        for (int i = 0; i < 3; ++i) s.T[i] += delta[i], s.v[i] += delta[3 + i], s.w[i] += delta[9 + i];
        identity(F);
        put(F, 6, 6, J);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) F[12 + i][12 + j] -= axis[i] * axis[j];
        sandwich(F, s.P);
        std::memcpy(T_out + 3 * frame, s.T, sizeof(s.T));
        std::memcpy(R_out + 9 * frame, s.R, sizeof(s.R));
        std::memcpy(P_out + static_cast<long>(D) * D * frame, s.P, sizeof(s.P));
    }
}
