"""Settings: thresholds that users may change, and the current values.

Changed settings apply inside `with use_settings(Settings(found_probability=0.99)):` and are written to `result.json`.
All other thresholds are constants of the modules that use them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Settings:
    """Thresholds of searches, acceptance checks and sampling.

    Attributes:
        found_probability: probability from which an effect, or one of a set, is reported as missing: odds of 19 to 1.
        prior_complete: prior probability that the model is complete; one half is neutral (docs/mathematics.md).
        strong_evidence: log Bayes factor, nats, of strong evidence: odds of 20 (Kass and Raftery, JASA 90 (1995) 773).
        power: probability that a repeated campaign would find an effect of the minimum detectable size; 0.8 is usual in
            the design of experiments (J. Cohen, Statistical Power Analysis, 1988).
        averaged_probability: minimum probability of a structure in the model average; others change no printed digit.
        finer_noise: whether sums of noise terms are evaluated if correlated noise is probable. Results may then pass
            acceptance checks that they fail with one Ornstein–Uhlenbeck process. Searches of thousands of readings take
            three to five times as long, searches of hundreds no longer.
        outlier_sd: leave-one-out residual, standard deviations, of an outlier; 1 normal reading in 16,000 exceeds ±4.
        holdout_p: p-value below which hold-out data contradict a result; a few valid results in a hundred are rejected.
        temperature_span: range, °C, below which a temperature counts as constant: the stability of a good chamber.
        effective_draws: minimum effective sample size of draws; 400 determine a standard deviation to 3.5 %.
    """

    found_probability: float = 0.95
    prior_complete: float = 0.5
    strong_evidence: float = 3.0
    power: float = 0.8
    averaged_probability: float = 0.01
    finer_noise: bool = True
    outlier_sd: float = 4.0
    holdout_p: float = 0.01
    temperature_span: float = 0.1
    effective_draws: int = 400


def to_seed(random: Any) -> int:
    """Return a seed: the given integer, or one drawn from a NumPy generator."""
    return int(random.integers(2**31) if hasattr(random, "integers") else random)


DEFAULTS = Settings()
_CURRENT: ContextVar[Settings] = ContextVar("settings", default=DEFAULTS)


def settings() -> Settings:
    """Return the current settings: those of `use_settings`, else the defaults."""
    return _CURRENT.get()


@contextmanager
def use_settings(new_settings: Settings) -> Iterator[None]:
    """Apply settings within the `with` block, in this thread; raise TypeError for another type."""
    if not isinstance(new_settings, Settings):
        raise TypeError(f"use_settings takes bayescal.Settings(…), not {new_settings!r}")
    token = _CURRENT.set(new_settings)
    try:
        yield
    finally:
        _CURRENT.reset(token)


def list_changed_settings() -> dict[str, float]:
    """Return the settings that differ from their defaults, by name."""
    return {name: v for name, v in asdict(settings()).items() if v != getattr(DEFAULTS, name)}
