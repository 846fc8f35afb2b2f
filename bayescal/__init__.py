"""bayescal: Bayesian calibration of inertial and tilt sensors.

Read readings, compose a model, fit it, check its residuals, find the missing effect, add it:

    import bayescal as bc
    from bayescal_models import mems_gyro

    readings = bc.read("table.csv", mems_gyro.INSTRUMENT)
    calibration = bc.fit(mems_gyro.INSTRUMENT.baseline(), readings)
    discovery = bc.discover(calibration)

The public names are listed in `__init__.pyi`, grouped by purpose. Each loads on first use, so that `import bayescal`
and `bayescal --help` are fast.
"""

# Terms, and the files and names below bayescal/ that define them; tests/house/test_map.py holds each.
# | Allan deviation | `_data/allan_deviation.py` `allan_deviation` |
# | checkpoint, resumed session | `_annexes/workbench/session_store.py` `save_session` |
# | collinear, equivalent effects | `_search/equivalence.py` `Equivalent`, `_core/null_space.py` `Spans` |
# | conformity, tolerance limits, guard band | `_annexes/metrology/conformity.py`, `_annexes/metrology/decide.py` |
# | convergence diagnostics | `_inference/trust.py` `assess_chains` |
# | coverage factor, sensitivity coefficient | `_use/budget.py` `Contribution`, `budget` |
# | credible interval | `_calibration/summary.py` `format_rows` |
# | degrees of freedom of the noise | `_inference/least_squares.py` `LeastSquares` |
# | evidence, marginal likelihood, Laplace approximation | `_inference/laplace.py` `find_mode` |
# | hold-out test | `_calibration/predict.py` `HoldoutTest` |
# | importance weight, effective sample size | `_core/importance_weights.py` `smooth` |
# | leave-one-out, leave-one-group-out | `_calibration/compare.py` `compare`, `_calibration/leave_group_out.py` |
# | misspecification, inadequacy | `_calibration/check.py` `check`, `_search/structure_average.py` `add_inadequacy` |
# | outlier, spike | `_data/set_aside.py` `exclude_faults` |
# | prior | `_model/prior.py` `Normal` |
# | residual | `_calibration/check.py` `check` |
# | tolerance of a solver, xtol, ftol | `_inference/laplace.py` `XTOL_SD`, `_inference/newton.py` `FTOL_NATS` |
# | whitening | `_inference/noise_on_record.py` `whitening`, `_inference/linear_model.py` `LinearModel` |

from warnings import warn as _warn

import lazy_loader

from bayescal._core import lazy_jax as lazy_jax  # sets JAX up once it is imported
from bayescal._core import python311 as python311
from bayescal._core.renamed import NOTICE as _NOTICE
from bayescal._core.version import __version__ as __version__

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    if name == "set_aside":
        name = "exclude_faults"
        _warn(_NOTICE.format("bayescal.set_aside", name), DeprecationWarning, stacklevel=2)
    try:
        return _load(name)
    except ModuleNotFoundError as error:
        if not str(error.name).startswith("bayescal._annexes"):
            raise
        raise ImportError(
            f"bayescal.{name} needs a component that is not installed ({error}): install all of bayescal"
        ) from None
