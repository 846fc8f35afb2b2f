"""A fitted structure as a linear model: whitened residual and nuisance columns, shapes among them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_triangular

from bayescal._engine.assembly import Assembly, Line
from bayescal._engine.closed_form import Density
from bayescal._engine.mode import Mode
from bayescal._engine.whitening import Whitening, whitening

STEP = 1e-4  # of a shape's coordinate, for the slope of the output by it


@dataclass(frozen=True, eq=False)
class LinearModel:
    """The readings as y = μ + columns·θ + noise about a mode.

    Attributes:
        assembly, mode: of the structure.
        line: at the mode.
        residual: at the posterior mean of θ, output unit (n,).
        nuisance: slopes by x and by the moving entries of φ, times their prior's standard deviations (n, q).
        weight: 1 where the prior is proper, 0 where it is flat (q,).
        owners: of each of these columns, the effect (q,).
        z: posterior mean of θ less its prior's, in these standard deviations (q,).
        whiten: of the readings.
    """

    assembly: Assembly
    mode: Mode
    line: Line
    residual: Float[np.ndarray, "n"]
    nuisance: Float[np.ndarray, "n q"]
    weight: Float[np.ndarray, "q"]
    sd: Float[np.ndarray, "q"]
    owners: tuple[str, ...]
    z: Float[np.ndarray, "q"]
    whiten: Whitening

    @property
    def size(self) -> int:
        return len(self.residual)

    @cached_property
    def white_residual(self) -> Float[np.ndarray, "n"]:
        return self.whiten(self.residual[:, None])[:, 0]

    @cached_property
    def white_nuisance(self) -> Float[np.ndarray, "n q"]:
        return self.whiten(self.nuisance)

    @cached_property
    def rest(self) -> float:
        """Sum of squares, the prior's share included."""
        return float(self.white_residual @ self.white_residual) + float(self.weight @ self.z**2)

    @cached_property
    def _chol(self) -> np.ndarray:
        inner = self.white_nuisance.T @ self.white_nuisance + np.diag(self.weight)
        return np.linalg.cholesky(inner + 1e-12 * np.diag(np.diag(inner)))

    def projected(self, columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "q k"]:
        """What of whitened columns the nuisances take: the information left is CᵀC − PᵀP."""
        return solve_triangular(self._chol, self.white_nuisance.T @ columns, lower=True)

    @cached_property
    def slopes(self) -> dict[str, np.ndarray]:
        """Of the expected output by each slot, at the mode."""
        return self.assembly.slopes(self.mode.point, self.assembly.hyper(self.mode.v))


def linear_model(assembly: Assembly, mode: Mode) -> LinearModel:
    """A structure about its mode."""
    density = Density(assembly, mode.point, mode.flat)
    hyper = assembly.hyper(mode.v)
    line = assembly.linearise(mode.point, hyper)
    prior = assembly.prior(hyper, mode.flat)
    _, found = density.at(mode.v)
    x = mode.point.x if found is None else found.mean
    back = np.sum(line.rows * mode.point.rows, axis=1)
    residual = assembly.record.y - line.mean + back - line.jacobian @ (x - mode.point.x)
    columns, sd = [line.jacobian * prior.sd], [prior.sd]
    there = type(mode.point)(x, mode.point.rows)
    for i in assembly.moving:
        up, down = mode.v.copy(), mode.v.copy()
        up[i] += STEP
        down[i] -= STEP
        ends = [assembly.linearise(there, assembly.hyper(v)).mean for v in (up, down)]
        columns.append(((ends[0] - ends[1]) / (2 * STEP))[:, None])
        sd.append(np.ones(1))
    z = np.where(prior.sd > 0, (x - prior.mean) / np.where(prior.sd > 0, prior.sd, 1.0), 0.0)
    own = [t.known.of for t in assembly.in_x for _ in range(t.at.start, t.at.stop)]
    return LinearModel(
        assembly=assembly,
        mode=mode,
        line=line,
        residual=residual,
        nuisance=np.concatenate(columns, axis=1),
        weight=np.append(prior.weight, np.ones(len(assembly.moving))),
        sd=np.concatenate(sd),
        owners=(*own, *(assembly.hypers[i].name.rpartition(".")[0] for i in assembly.moving)),
        z=np.append(z, np.zeros(len(assembly.moving))),
        whiten=whitening(assembly.noise, hyper, assembly.record, density.extra(line)),
    )
