"""What is customary on a temperature ramp, on the same splits as `thermal_ramp`: polynomials, a lag, sparse regression,
boosted trees.

Each recipe is fitted to the readings that are kept, without their spikes, and predicts those held out with the
temperature's whole past. None says how far it is to be trusted; what they cost is a second or two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import lfilter

from bayescal._data.time_in_runs import causal_slope

MINUTE = 60.0  # s
LAGS = (20.0, 3000.0)  # s, between which the shared lag is looked for
SPARSE = 0.05  # standard deviations of the output, below which STLSQ leaves a standardised term out
ROUNDS = 10  # of it at most
RECIPES = {
    "line": "a line in temperature",
    "cubic": "a cubic",
    "cubic + rate": "a cubic and the rate of the last minute",
    "cubic + lag": "a cubic, one lag and how it began; its time shared by the six channels, by least squares",
    "STLSQ": "sequentially thresholded least squares (SINDy) on products of temperature, rate and lag, to third order",
    "boosted trees": "scikit-learn's HistGradientBoostingRegressor on temperature, rate and lag, as it comes",
}

Fit = Callable[[np.ndarray, np.ndarray], np.ndarray]  # kept, output ↦ prediction of every reading


def errors(
    time: np.ndarray, temperature: np.ndarray, outputs: Mapping[str, np.ndarray], held: np.ndarray
) -> dict[str, dict[str, float]]:
    """Root mean square of the held-out readings about each recipe's prediction: recipe → channel → error.

    Args:
        time: s, from the start (n,).
        temperature: °C (n,).
        outputs: of each channel, NaN where it is set aside (n,).
        held: which readings are held out (n,).
    """
    kept = {name: ~held & np.isfinite(y) for name, y in outputs.items()}
    tau = shared_lag(time, temperature, outputs, kept)
    fits = _recipes(time, temperature, tau)
    return {
        recipe: {name: _rms((y - fit(kept[name], y))[held]) for name, y in outputs.items()}
        for recipe, fit in fits.items()
    }


def shared_lag(time, temperature, outputs, kept) -> float:
    """The lag time, s, of least squares over all channels, each in parts of what a cubic leaves."""
    cubic = _powers(temperature, 3)

    def left(log_tau: float) -> float:
        columns = np.column_stack([cubic, *lag(time, temperature, np.exp(log_tau))])
        return sum(
            len(y[kept[n]]) * np.log(_rms((y - _linear(columns)(kept[n], y))[kept[n]]))
            for n, y in outputs.items()
        )

    grid = np.log(np.geomspace(LAGS[0], LAGS[1], 25))
    best = int(np.argmin([left(v) for v in grid]))
    ends = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    return float(np.exp(minimize_scalar(left, bounds=ends, method="bounded")["x"]))  # pyright: ignore[reportIndexIssue]


def lag(time: np.ndarray, temperature: np.ndarray, tau: float) -> tuple[np.ndarray, np.ndarray]:
    """T̃ − T of a body that follows with the time τ, and what is left of where it began."""
    share = np.exp(-float(np.median(np.diff(time))) / tau)
    followed, _ = lfilter([1 - share], [1, -share], temperature, zi=[share * temperature[0]])
    return followed - temperature, np.exp(-(time - time[0]) / tau)


def _recipes(time: np.ndarray, temperature: np.ndarray, tau: float) -> dict[str, Fit]:
    step = np.r_[-1.0, np.diff(time)]
    rate = MINUTE * causal_slope(time, temperature, np.arange(time.size), step)
    behind, began = lag(time, temperature, tau)
    cubic = _powers(temperature, 3)
    return {
        "line": _linear(_powers(temperature, 1)),
        "cubic": _linear(cubic),
        "cubic + rate": _linear(np.column_stack([cubic, rate])),
        "cubic + lag": _linear(np.column_stack([cubic, behind, began])),
        "STLSQ": _sparse(_products([temperature, rate, behind], 3)),
        "boosted trees": _trees(np.column_stack([temperature, rate, behind])),
    }


def _powers(values: np.ndarray, order: int) -> np.ndarray:
    scaled = (values - values.mean()) / np.ptp(values)
    return scaled[:, None] ** np.arange(order + 1)


def _products(values: list[np.ndarray], order: int) -> np.ndarray:
    """All products up to an order, standardised, beside a constant."""
    from sklearn.preprocessing import PolynomialFeatures

    scaled = [(v - v.mean()) / np.ptp(v) for v in values]
    made = PolynomialFeatures(order, include_bias=False).fit_transform(np.column_stack(scaled))
    return np.column_stack([np.ones(len(made)), made / made.std(axis=0)])


def _linear(columns: np.ndarray) -> Fit:
    def predicted(kept, y):
        return columns @ np.linalg.lstsq(columns[kept], y[kept], rcond=None)[0]

    return predicted


def _sparse(columns: np.ndarray) -> Fit:
    """S. Brunton, J. Proctor and N. Kutz, PNAS 113 (2016) 3932: least squares, small terms out, again."""

    def predicted(kept, y):
        least = SPARSE * y[kept].std()
        here = np.ones(columns.shape[1], dtype=bool)
        for _ in range(ROUNDS):
            size = np.linalg.lstsq(columns[kept][:, here], y[kept], rcond=None)[0]
            left = np.abs(size) > least
            left[0] = True  # the constant
            if left.all():
                break
            here[here] = left
        return _linear(columns[:, here])(kept, y)

    return predicted


def _trees(columns: np.ndarray) -> Fit:
    def predicted(kept, y):
        from sklearn.ensemble import HistGradientBoostingRegressor

        grown = HistGradientBoostingRegressor(random_state=0).fit(columns[kept], y[kept])
        return grown.predict(columns)

    return predicted


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
