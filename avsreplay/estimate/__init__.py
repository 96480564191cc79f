"""State estimation: the noise-adaptive constrained Kalman filter and the maximum-likelihood
batch fit.
"""

try:
    import avsreplay.estimate._motion  # noqa: F401
except ImportError:
    from avsreplay.errors import MissingBackend

    raise MissingBackend(
        "the C++ extensions are not built",
        where="avsreplay.estimate._motion",
        hint="run 'pip install .' in the source folder (needs a C++17 compiler), then Python"
        " outside of it",
    ) from None

from avsreplay.estimate.dynamics import after_change
from avsreplay.estimate.estimator import Estimator
from avsreplay.estimate.params import EstimatorParams
from avsreplay.estimate.track import Prediction, Track, in_doubt

__all__ = ["Estimator", "EstimatorParams", "Prediction", "Track", "after_change", "in_doubt"]
