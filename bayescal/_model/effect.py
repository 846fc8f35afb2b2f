"""One named physical term: a basis, linear in its coefficients, that adds to a slot."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from bayescal._core.errors import ModelError
from bayescal._model.coefficient import Coefficient, Shape
from bayescal._model.frame import Frame
from bayescal._readings.measurements import Measurements


class Effect(eqx.Module):
    """One named physical term of a measurement equation.

    The author of an effect writes one small function of the readings:

        humidity = bc.Effect(
            "bias.humidity", slot="bias", columns=("humidity",),
            basis=lambda r: r["humidity"] - 50.0,
            coefficients=(bc.Coefficient("deg/s/%", bc.Normal(0, 0.01)),),
            equation="c·(H − 50 %)",
        )

    Attributes:
        name: canonical name, `slot.cause`.
        slot: the slot of the instrument that it adds to. A slot named after a column corrects that column
            before any other effect sees it (errors in variables).
        basis: function of a `Frame` and, as keywords, of the shapes; one column (n,) or several (n, p),
            one for each coefficient, in the instrument's fixed units.
        coefficients: the unknowns, in the order of the basis columns.
        shapes: unknowns that the basis is not linear in.
        columns: what the readings must have.
        equation, source: for people; the source is a document, data sheet, standard or script.
        varies: a column that must take more than one value for the effect to be testable.
        weights: function of some shapes (as keywords) that gives the prior standard deviation of each coefficient,
            in parts of its plausible size. These shapes are no arguments of the basis.
        measure: the shape that says how large the effect is, as an amplitude of standard normal coefficients;
            None where its first coefficient does.
        untestable: why readings that have all this still cannot test the effect, or None where they can.
        along: covariate along which a real law may depart smoothly from this form: a numeric column, "elapsed", or a
            rate such as "temperature rate". None stands for the one column that it needs; "" for no such covariate.
    """

    name: str = eqx.field(static=True)
    slot: str = eqx.field(static=True)
    basis: Callable[..., Float[Array, "n"] | Float[Array, "n p"] | float] = eqx.field(static=True)
    coefficients: tuple[Coefficient, ...]
    shapes: tuple[Shape, ...] = ()
    columns: tuple[str, ...] = eqx.field(static=True, default=())
    equation: str = eqx.field(static=True, default="")
    source: str = eqx.field(static=True, default="the user's own")
    varies: tuple[str, ...] = eqx.field(static=True, default=())
    weights: Callable[..., Any] | None = eqx.field(static=True, default=None)
    measure: str | None = eqx.field(static=True, default=None)
    untestable: Callable[[Measurements], str | None] | None = eqx.field(static=True, default=None)
    along: str | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        if not self.coefficients:
            raise ModelError(f"effect {self.name!r} has no coefficient: give at least one")
        parts = [c.part for c in self.coefficients]
        if len(set(parts)) != len(parts):
            raise ModelError(
                f"effect {self.name!r}: its coefficients need different parts, not {parts}"
            )
        taken = inspect.signature(self.basis).parameters
        shapes = {s.name for s in self.shapes} - set(self.weight_shapes)
        needed = {
            name for name, p in taken.items() if p.default is p.empty
        }  # not `lambda r, k=k: …`
        if not shapes <= set(taken) or len(needed - shapes) != 1:
            raise ModelError(
                f"effect {self.name!r}: its basis must take the readings and then its shapes "
                f"{sorted(shapes)} by name; it takes {list(taken)}"
            )

    @property
    def is_placeholder(self) -> bool:
        """Whether it stands for what no named effect describes: sized by an amplitude, not by a coefficient."""
        return self.measure is not None

    @property
    def open(self) -> bool:
        """Whether its plausible amplitude is to be taken from the readings."""
        return any(s.open for s in self.shapes)

    def sized(self, low: float, high: float) -> Effect:
        """The effect with this range of its amplitude, in the shape's unit, where it is open."""
        shapes = (replace(s, low=low, high=high) if s.open else s for s in self.shapes)
        return replace(self, shapes=tuple(shapes))

    @property
    def departs_along(self) -> str:
        """The covariate of a smooth departure from its form; "" for none, or where members would have their own."""
        several = any(c.per is not None or c.slot is not None for c in self.coefficients)
        if self.is_placeholder or several:
            return ""
        if self.along is None:
            return self.columns[0] if len(self.columns) == 1 else ""
        return self.along

    @property
    def weight_shapes(self) -> tuple[str, ...]:
        """Shapes that say how large the coefficients may be, and not how the columns run."""
        return () if self.weights is None else tuple(inspect.signature(self.weights).parameters)

    @property
    def column_shapes(self) -> tuple[Shape, ...]:
        """Shapes that the columns depend on."""
        apart = self.weight_shapes
        return tuple(s for s in self.shapes if s.name not in apart)

    def coefficient_name(self, index: int) -> str:
        part = self.coefficients[index].part
        return f"{self.name}[{part}]" if part else self.name

    def shape_name(self, shape: Shape) -> str:
        return f"{self.name}.{shape.name}"

    def evaluate(self, frame: Frame, shapes: dict[str, Float[Array, ""]]) -> Float[Array, "n p"]:
        """The basis as a matrix, one column a coefficient; constants are spread over the readings.

        Raises:
            ModelError: the basis has another number of columns than there are coefficients.
        """
        own = {s.name: shapes[s.name] for s in self.column_shapes}
        return self.matrix(self.basis, len(self.coefficients), self.name, frame, own)

    @staticmethod
    def matrix(
        basis: Callable[..., Float[Array, "n"] | Float[Array, "n p"] | float],
        count: int,
        name: str,
        frame: Frame,
        shapes: dict[str, Float[Array, ""]],
    ) -> Float[Array, "n p"]:
        """`evaluate` of a basis by itself: with how many coefficients, and whose it is."""
        columns = jnp.asarray(basis(frame, **shapes), dtype=float)
        if columns.ndim < 2:
            columns = jnp.broadcast_to(columns, (frame.size,))[:, None]
        if columns.shape != (frame.size, count):
            raise ModelError(
                f"effect {name!r}: its basis returned shape {columns.shape}; with "
                f"{count} coefficient(s) and {frame.size} readings it must return "
                f"{(frame.size, count)}"
            )
        return columns
