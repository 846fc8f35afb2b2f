"""bayescal: Bayesian calibration of inertial and tilt sensors.

Read readings, compose a model, fit it, check its residuals, find the missing effect, add it:

    import bayescal as bc
    from bayescal_models import mems_gyro

    readings = bc.read("table.csv", mems_gyro.INSTRUMENT)
    calibration = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings)
    found = bc.discover(calibration)

The public names stand in `__init__.pyi`, grouped by what they are for. Each loads on first use, so that
`import bayescal` and `bayescal --help` cost nothing.
"""

import lazy_loader

from bayescal._core import lazy_jax as lazy_jax  # sets JAX up once it is imported
from bayescal._core import python311 as python311
from bayescal._core.version import __version__ as __version__

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        if not str(error.name).startswith("bayescal._annexes"):
            raise
        raise ImportError(
            f"bayescal.{name} needs a component that is not installed ({error}): install all of bayescal"
        ) from None
