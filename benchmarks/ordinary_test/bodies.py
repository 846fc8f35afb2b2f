"""Thermal bodies as capacities and conductances, integrated in fine steps: chamber, package, die, slab, self-heating.

Independent of the library and of closed-form solutions: each body is a network of cells,
C·dT/dt = G·(neighbours − T) + P, integrated by the trapezoidal rule, which conserves energy to the last digit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
CELLS = 60  # of a slab: twice as many move its temperature by less than 1e-3 of a step's height


@dataclass(frozen=True)
class Body:
    """A row of cells between a face and an insulated end: a package, a die or a slab.

    Attributes:
        capacity: heat capacity of each cell, J/°C, (n,).
        conductance: conductance from outside to the first cell, then from cell to cell, W/°C, (n,).
        weight: weight of each cell in the sensing temperature, (n,); they sum to one.
    """

    capacity: Array
    conductance: Array
    weight: Array

    @property
    def between(self) -> Array:
        """Return the matrix from cell temperatures to heat flows into cells, W/°C, (n, n); the outside is at 0 °C."""
        n = len(self.capacity)
        conductance = np.zeros((n, n))
        conductance[0, 0] -= self.conductance[0]
        for i, g in enumerate(self.conductance[1:]):
            conductance[i : i + 2, i : i + 2] += g * np.array([[-1.0, 1.0], [1.0, -1.0]])
        return conductance

    def cells(self, outside: Array, step: float, start: Array, power: float = 0.0) -> Array:
        """Return the temperatures of all cells, °C, (times, n).

        Args:
            outside: temperature at the face, °C, linear between steps, (times,).
            step: time step, s.
            start: initial temperatures of the cells, °C, (n,).
            power: power of a heater in the last cell, W.
        """
        root = np.sqrt(self.capacity)
        rates, modes = np.linalg.eigh(self.between / np.outer(root, root))
        by_face = modes[0] * self.conductance[0] / root[0]
        by_heater = modes[-1] * power / root[-1]
        mean = 0.5 * (outside[1:] + outside[:-1])
        temperatures = np.empty((len(rates), len(outside)))
        # The rule in each mode by itself, z' = λz + p: (1 − hλ/2)·zᵢ₊₁ = (1 + hλ/2)·zᵢ + h·p.
        for i, first in enumerate(modes.T @ (root * start)):
            ahead = 1 / (1 - 0.5 * step * rates[i])
            keep = (1 + 0.5 * step * rates[i]) * ahead
            push = step * ahead * (by_face[i] * mean + by_heater[i])
            temperatures[i] = lfilter([1.0], [1.0, -keep], np.r_[first, push])
        return (modes @ temperatures).T / root

    @property
    def behind(self) -> float:
        """Return the lag behind a steady ramp, s."""
        return float(np.linalg.solve(-self.between, self.capacity) @ self.weight)

    def settled(self, outside: float, power: float = 0.0) -> Array:
        """Return the cells' equilibrium temperatures, °C, (n,)."""
        return outside + power * np.cumsum(1 / self.conductance)

    def inside(self, outside: Array, step: float) -> Array:
        """Return the sensing temperature, °C, (times,), from equilibrium with the first outside temperature."""
        start = self.settled(float(outside[0]))
        return self.cells(outside, step, start) @ self.weight

    def warming(self, times: Array, step: float) -> Array:
        """Return the remaining fraction of the last cell's self-heating after power-on, 1 at first, (times,).

        Args:
            times: time since power-on, s, from 0 in equal steps.
            step: time step, s.
        """
        response = self.cells(0.0 * times, step, 0.0 * self.capacity, power=1.0)[:, -1]
        return 1 - response / self.settled(0.0, 1.0)[-1]


def lump(time: float) -> Body:
    """Return a single cell with this time constant, s."""
    return Body(np.array([time]), np.ones(1), np.ones(1))


def two_stages(first: float, second: float, share: float) -> Body:
    """Return a die on a substrate on the package; the die's heat flows through the substrate.

    Args:
        first: capacity of the substrate over its conductance to the package, s.
        second: capacity of the die over its conductance to the substrate, s.
        share: capacity of the die over that of the substrate.
    """
    capacity = first * np.array([1.0, share])
    return Body(capacity, np.array([1.0, first * share / second]), np.array([0.0, 1.0]))


def slab(time: float, contact: float, mean: bool, cells: int = CELLS) -> Body:
    """Return a slab with heat diffusion, behind a contact; it senses its mean, or its far face.

    Args:
        time: thickness² over diffusivity, s.
        contact: conductance of the contact over that of the slab (its Biot number).
        mean: whether the mean is sensed; otherwise the far face.
        cells: number of cells.
    """
    capacity = np.full(cells, time / cells)
    inner = float(cells)  # from cell to cell; half a cell lies before the first
    conductance = np.full(cells, inner)
    conductance[0] = 1 / (1 / contact + 0.5 / cells)
    weight = np.full(cells, 1 / cells) if mean else np.eye(cells)[-1]
    return Body(capacity, conductance, weight)


@dataclass(frozen=True)
class Chamber:
    """The air of a controlled chamber: a second-order response with overshoot, and limited power.

    Attributes:
        period: period of the undamped oscillation, s.
        damping: damping ratio; below 1 it overshoots.
        fastest: largest rate of the air temperature, °C/s.
        wander: standard deviation of temperature variations that the controller leaves, °C.
    """

    period: float
    damping: float
    fastest: float
    wander: float

    def air(self, goal: Array, step: float, rng: np.random.Generator) -> Array:
        """Return the air temperature, °C, (times,), from rest at the first set point."""
        rate = 2 * np.pi / self.period
        kicks = rng.standard_normal(len(goal)) * self.wander * np.sqrt(2 * step / 300.0)
        temperature = np.empty_like(goal)
        air, speed, loose = float(goal[0]), 0.0, 0.0
        for i, (goal_now, kick) in enumerate(zip(goal.tolist(), kicks.tolist(), strict=True)):
            temperature[i] = air
            loose += kick - loose * step / 300.0
            force = rate**2 * (goal_now + loose - air) - 2 * self.damping * rate * speed
            speed = min(max(speed + step * force, -self.fastest), self.fastest)
            air += step * speed
        return temperature
