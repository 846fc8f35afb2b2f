"""bayescal: Bayesian calibration of inertial and tilt sensors.

Read readings, compose a model, fit it, see where it fails, find the effect that is missing, add it:

    import bayescal as bc
    from bayescal_models import mems_gyro

    readings = bc.read("table.csv", mems_gyro.INSTRUMENT)
    calibration = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings)
    found = bc.discover(calibration)

The public names stand in `__init__.pyi`, grouped by what they are for. Each loads on first use, so that
`import bayescal` and `bayescal --help` cost nothing.
"""

import warnings

import lazy_loader

from bayescal._core import jax_setup as jax_setup  # before JAX: see the comment there
from bayescal._core.version import __version__ as __version__

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

_RENAMED = {
    "Trail": "SearchPath",
    "template": "draft_effect",
}  # since 0.2.0; the old names go in 0.3.0


def __getattr__(name: str):
    new = _RENAMED.get(name)
    if new is None:
        return _load(name)
    text = f"bayescal.{name} is called bayescal.{new} now; the old name goes in 0.3.0"
    warnings.warn(text, DeprecationWarning, stacklevel=2)
    return _load(new)
