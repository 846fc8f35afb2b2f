"""What a fit of many devices says of one of them, and of those that have the same unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayescal._core.errors import InputError


@dataclass(frozen=True, eq=False)
class BatchPart:
    """Devices that have the same unknowns.

    Attributes:
        devices: their places in the batch.
        names, units: of the unknowns.
        mean: (b, q), in these units.
        covariance: (b, q, q); NaN for what is held at its estimate (noise and spreads, by least squares).
    """

    devices: np.ndarray
    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        """Standard uncertainties, (b, q)."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2)
        return np.sqrt(np.where(variance >= 0, variance, np.nan))


@dataclass(frozen=True, eq=False)
class DeviceResult:
    """One device of a batch.

    Attributes:
        device: its name.
        ok: whether to trust it.
        reason: why not: a refusal, or what the fit did not reach; empty if nothing.
        names, units: of its unknowns; none if it was refused.
        mean: (q,), in these units.
        covariance: (q, q).
    """

    device: str
    ok: bool
    reason: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        """Standard uncertainties, (q,)."""
        return np.sqrt(np.diag(self.covariance))

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Mean and standard uncertainty of one unknown.

        Raises:
            InputError: nothing is called so.
        """
        if name not in self.names:
            raise InputError(
                f"device {self.device!r} has no unknown {name!r}; it has: {', '.join(self.names) or 'none'}"
                f"{' (' + self.reason + ')' if self.reason else ''}"
            )
        i = self.names.index(name)
        return float(self.mean[i]), float(self.sd[i])

    def __str__(self) -> str:
        head = f"device {self.device}: {'ok' if self.ok else self.reason}"
        known = [("" if np.isnan(s) else f" ± {s:.2g}") for s in self.sd]
        rows = zip(self.names, self.mean, known, self.units, strict=True)
        return "\n".join([head, *(f"  {n} = {m:.6g}{s} {u}" for n, m, s, u in rows)])
