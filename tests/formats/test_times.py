import numpy as np
import pytest

from jaxtri import formats
from jaxtri.formats.times import parse_stamps, stamp_unit

STEPS = np.round(np.cumsum([0, 0.05, 0.05, 0.04, 0.06, 0.05]), 3)


@pytest.mark.parametrize("start", [0.0, 3600.0 * 24, 1_403_636_579.763])  # of a clock from 0, of a computer, of the day
@pytest.mark.parametrize(("unit", "per"), [(1.0, 1), (1e-6, 10**6), (1e-9, 10**9)])
def test_the_unit_of_stamps_is_told_by_their_size_and_step(start, unit, per):
    stamps = np.round((start + STEPS) * per) if per > 1 else start + STEPS
    assert stamp_unit(stamps) == unit
    np.testing.assert_allclose(parse_stamps([f"{s:.9g}" if s < 1e6 else f"{s:f}" for s in stamps]), start + STEPS)


def test_whole_seconds_and_whole_milliseconds():
    assert stamp_unit(np.arange(5.0)) == 1  # frame numbers, or a frame a second
    assert stamp_unit(1.7e9 + np.arange(5) * 60) == 1  # a time lapse
    assert stamp_unit(1.7e12 + np.arange(5) * 40) == 1e-3


def test_dates_count_from_1970_to_the_nanosecond_that_a_double_keeps():
    words = ["2011-09-26 13:02:59.964389445", "2011-09-26 13:03:00.067890123", "2011-09-26T13:03:01Z"]
    t = parse_stamps(words)
    np.testing.assert_allclose(np.diff(t), [0.103500678, 0.932109877], atol=5e-7)
    assert int(t[0]) == 1317042179
    assert np.isnan(parse_stamps([words[0], "2011-06-31 00:00:00"])).tolist() == [False, True]


def test_files_of_time_stamps(tmp_path):
    for content, times in (
        (
            "#timestamp [ns],filename\n1700000000000000000,1700000000000000000.png\n1700000000050000000,b.png\n",
            [0, 0.05],
        ),
        ("timestamp,filename\n0.5,a.png\n1.0,b.png\n", [0.5, 1.0]),
        ("0.000000e+00\n1.035e-01\n", [0, 0.1035]),
        ("00000 1436286846.5 0.01\n00001 1436286846.55 0.02\n", [1436286846.5, 1436286846.55]),  # TUM's monocular
        ("0.0 3\n0.5 3\n", [0, 0.5]),
    ):
        (tmp_path / "t").write_text(content)
        found = formats.read_timestamps(tmp_path / "t")
        offset = 1.7e9 if "ns" in content else 0
        np.testing.assert_allclose(found, np.array(times) + offset, rtol=0, atol=3e-7)
