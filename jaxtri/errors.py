"""What can go wrong at the host boundary, as types; each message says what is wrong and what to try."""


class JaxtriError(Exception):
    """Base of every error this package raises on purpose."""


class InputError(JaxtriError, ValueError):
    """An argument, array or file that cannot be used as given."""


class CameraError(InputError):
    """Intrinsics that are missing, not finite, negative or of an unknown model."""


class VideoError(InputError):
    """A source of frames that cannot be opened or read."""


class ResolutionChangeError(VideoError):
    """The frame size changed midway through a source."""


class TruncatedVideoError(VideoError):
    """Fewer frames could be decoded than the source declares (raised with `strict` only)."""


class InputWarning(UserWarning):
    """What was noticed of an input, and how it is taken; the command line shows each."""


class SourceWarning(InputWarning):
    """What a source of frames does not say, or says in an unusual way, and how it is taken."""


class TruncatedVideoWarning(InputWarning):
    """Fewer frames could be decoded than the source declares."""


class UnitsWarning(UserWarning):
    """What should be in normalised image units is clearly in pixels, or the other way round."""


class TrajectoryError(InputError):
    """A trajectory file that cannot be parsed, or trajectories that cannot be compared."""


class TrajectoryWarning(InputWarning):
    """Lines of a trajectory that are left out, or times that had to be found elsewhere."""


class InitialisationError(JaxtriError):
    """No camera motion could be recovered from the whole sequence."""
