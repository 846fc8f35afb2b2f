"""A structure on a record: its expected output, Jacobian and priors, put together from columns and slopes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayescal._inference.gaussian import Prior
from bayescal._inference.record import Record
from bayescal._inference.terms import Correction, Sizes, Term
from bayescal._model.parameters import MOVING, Layout

Values = dict[str, float]
NUDGE = 1e-6  # of a coordinate, for derivatives of priors,
SHIFT = 1e-4  # and of columns of the expected output


class Point(NamedTuple):
    """Where the expected output is linearised: x̂ (p,) and the per-reading coefficients (n, k); NumPy's or JAX's."""

    x: Any
    rows: Any


class Line(NamedTuple):
    """The expected output and its derivatives at one point: by x (n, p), by the per-reading coefficients (n, k)."""

    mean: Float[np.ndarray, "n"]
    jacobian: Float[np.ndarray, "n p"]
    rows: Float[np.ndarray, "n k"]


class Moved(NamedTuple):
    """Slopes by one coordinate of φ: of some columns of the Jacobian, of the expected output, of the row columns."""

    at: Int[np.ndarray, "k"]
    columns: Float[np.ndarray, "n k"]
    mean: Float[np.ndarray, "n"]
    rows: Float[np.ndarray, "n r"]


@dataclass(eq=False)
class Assembly:
    """A structure bound to a record.

    Attributes:
        layout: which unknowns there are, and where.
        record: the readings.
        size_factors: on the plausible sizes of an effect's coefficients, by the effect's name; one where not named.
    """

    layout: Layout
    record: Record
    size_factors: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        layout = self.layout
        slots = self.record.slots
        correcting = [b for b in layout.blocks if b.slot not in slots]
        self.corrected = tuple(dict.fromkeys(b.slot for b in correcting))
        corrections: tuple[Correction, ...] = ()
        blocks = layout.blocks
        # What corrects a column without an unknown but its shapes, as the temperature of a body does, is part of the
        # other effects' columns: these stay linear in their coefficients.
        if correcting and all(b.place == "fixed" and b.size == 1 for b in correcting):
            corrections, self.corrected = tuple(map(Correction.of_block, correcting)), ()
            blocks = tuple(b for b in blocks if b.slot in slots)
        own = {b.effect.name for b in correcting}
        self.terms = tuple(
            Term.of_block(
                b,
                self.record.plain,
                self.size_factors or {},
                () if b.effect.name in own else corrections,
            )
            for b in blocks
        )
        self.hypers = layout.hypers
        self.size = sum(t.size for t in self.terms if t.place == "x")
        of_rows = [t for t in self.terms if t.place == "row"]
        self._row_of = {(t.known.of, t.index): i for i, t in enumerate(of_rows)}
        self.row_sd = np.array([t.prior_sd for t in of_rows])
        self.noise = layout.model.noise
        self.fixed_values = dict(layout.model.fixed)
        # A promoted coefficient in units of a learned spread moves with that spread too.
        scaled = {t.group_sd_name for t in self.terms if t.place == "phi"}
        self.kinds = [h.kind for h in self.hypers]
        self.moving = [i for i, h in enumerate(self.hypers) if h.kind in MOVING or h.name in scaled]
        self._coordinates = [(h.name, h.prior.value, h.prior.log_density) for h in self.hypers]

    # φ and the priors -------------------------------------------------------------------------------------------

    def hyper(self, v: Sequence[float] | np.ndarray) -> Values:
        """The entries of φ at coordinate v, by name; fixed ones included."""
        found = {
            name: value(one) for (name, value, _), one in zip(self._coordinates, v, strict=True)
        }
        return {**self.fixed_values, **found}  # pyright: ignore[reportReturnType]

    def log_prior(self, v: np.ndarray) -> float:
        """Log prior density of φ in its coordinates."""
        return float(
            sum(density(one) for (*_, density), one in zip(self._coordinates, v, strict=True))
        )

    def log_priors(self, v: Float[np.ndarray, "b d"]) -> Float[np.ndarray, "b"]:
        """Log prior densities of several φ."""
        parts = [density(v[:, i]) for i, (*_, density) in enumerate(self._coordinates)]
        return np.sum(parts, axis=0) if parts else np.zeros(len(v))

    def value_slope(self, v: np.ndarray, i: int) -> float:
        """Slope of the logarithm of one entry of φ by its coordinate."""
        # Positive unknowns move by their logarithm: a difference of logarithms has no units to lose.
        value = self._coordinates[i][1]
        return float(np.log(value(v[i] + NUDGE) / value(v[i] - NUDGE))) / (2 * NUDGE)

    def value_change(self, v: np.ndarray, i: int) -> float:
        """Slope of one entry of φ by its coordinate."""
        value = self._coordinates[i][1]
        return float(value(v[i] + NUDGE) - value(v[i] - NUDGE)) / (2 * NUDGE)

    def log_variance_slope(self, v: np.ndarray, i: int) -> float:
        """Slope of the logarithm of the variance that all readings share, by one coordinate."""

        def log_variance(one: np.ndarray) -> float:
            moved = np.concatenate([v[:i], one, v[i + 1 :]])
            return float(np.log(self.noise.shared_variance(self.hyper(moved))))

        return float(differences(log_variance, v[[i]], NUDGE)[0])

    def log_sd_slopes(
        self, v: np.ndarray, hyper: Values
    ) -> Iterator[tuple[int, Float[np.ndarray, "p"]]]:
        """Slopes of the logarithms of x's prior standard deviations, by each coordinate that moves any of them."""
        # Sizes move with learned spreads, all members of a group alike, and with shapes that weigh coefficients.
        places = {h.name: i for i, h in enumerate(self.hypers)}
        for name, members in self.sizes.members.items():
            if (i := places.get(name)) is not None:
                yield i, self.value_slope(v, i) * members
        for name in self.sizes.weighing:
            if (i := places.get(name)) is not None:
                value = self._coordinates[i][1]
                up, down = (
                    self.sizes.log_weights(name, {**hyper, name: value(v[i] + s)})
                    for s in (NUDGE, -NUDGE)
                )
                yield i, (up - down) / (2 * NUDGE)

    def log_prior_slope(self, v: np.ndarray) -> np.ndarray:
        pairs = zip(self._coordinates, v, strict=True)
        found = [float(d(one + NUDGE) - d(one - NUDGE)) / (2 * NUDGE) for (*_, d), one in pairs]
        return np.array(found)

    @cached_property
    def in_x(self) -> tuple[Term, ...]:
        return tuple(t for t in self.terms if t.place == "x")

    @cached_property
    def sizes(self) -> Sizes:
        """Prior standard deviations of x given φ."""
        return Sizes(self.in_x, self.layout.model.effects, self.size)

    @cached_property
    def mean_of_x(self) -> Float[np.ndarray, "p"]:
        found = np.zeros(self.size)
        for t in self.in_x:
            found[t.at] = t.known.mean
        return found

    @cached_property
    def weight_of_x(self) -> Float[np.ndarray, "p"]:
        found = np.ones(self.size)
        for t in self.in_x:
            if t.known.flat:
                found[t.at] = 0.0
        return found

    def prior(
        self, hyper: Mapping[str, Any], flat: np.ndarray, count: tuple[int, ...] = ()
    ) -> Prior:
        """Of x given φ, or given each of `count`; `flat` are the scales where it is flat."""
        sd = np.where(self.weight_of_x > 0, self.sizes.at(hyper, count), flat)
        return Prior(self.mean_of_x, sd, self.weight_of_x)

    @property
    def start(self) -> Point:
        """At the priors' means; a constant that outputs are counted from stands at its origin, near which they are."""
        x = self.mean_of_x.copy()
        for b in self.layout.x_blocks:
            if b.origin:
                x[b.start : b.start + b.size] = 0.0
        return Point(x, np.zeros((self.record.size, len(self.row_sd))))

    def point_of(self, other: Assembly, point: Point) -> Point:
        """Another structure's point in this one's terms; what that one has not stands at its prior mean."""
        found, theirs = self.start, {(t.known.of, t.index): t.at for t in other.in_x}
        for t in self.in_x:
            if (at := theirs.get((t.known.of, t.index))) is not None:
                found.x[t.at] = point.x[at]
        return found._replace(rows=point.rows) if point.rows.shape == found.rows.shape else found

    # the expected output ----------------------------------------------------------------------------------------

    def values(self, x: np.ndarray, rows: np.ndarray, hyper: Mapping[str, Any]) -> list[Any]:
        """Each term's coefficient at each reading (…, n), or one for all (…, 1), of one draw or of several."""
        of_rows = iter(np.moveaxis(rows, -1, 0))
        return [next(of_rows) if t.place == "row" else self.value(t, x, hyper) for t in self.terms]

    def value(self, t: Term, x: np.ndarray, hyper: Mapping[str, Any]) -> np.ndarray:
        """That of one term which is none of single readings."""
        draws = x.shape[:-1]
        if t.place == "x":
            value = x[..., t.at]
        elif t.place == "fixed":
            value = np.full((*draws, t.size), t.value)
        else:
            value = np.stack([np.broadcast_to(hyper[name], draws) for name in t.members], axis=-1)
            if t.group_sd_name is not None:
                # Held in units of its learned spread (non-centred), so that a spread near zero makes no funnel (O.
                # Papaspiliopoulos, G. Roberts and M. Sköld, Stat. Sci. 22 (2007) 59).
                spread = np.broadcast_to(hyper[t.group_sd_name], draws)[..., None]
                value = t.known.mean + spread * value
        if t.known.per is None:
            return value
        none = np.zeros((*draws, 1))  # the code of no member is −1
        return np.concatenate([value, none], axis=-1)[..., self.record.codes[t.known.per]]

    def _columns(self, terms: Sequence[Term], hyper: Values, moves: Mapping[str, np.ndarray]):
        """The column of each term, slot units per reported unit, and its slopes by the moved columns."""
        found, last, made = [], None, None
        for t in terms:
            if t.known.of != last:
                shapes = tuple(float(hyper[name]) for name in t.known.shape_names)
                if moves and t.slot not in moves:
                    made = self.record.moved_columns(t.known.columns, shapes, moves)
                else:
                    made = self.record.columns(t.known.columns, shapes), {}
                last = t.known.of
            columns, slopes = made  # pyright: ignore[reportGeneralTypeIssues]
            by_move = {name: s[:, t.index] * t.factor for name, s in slopes.items()}
            found.append((columns[:, t.index] * t.factor, by_move))
        return found

    def slopes(self, point: Point, hyper: Values) -> dict[str, Float[np.ndarray, "n"]]:
        """Of the expected output by each slot, reading by reading."""
        return self.record.affine[1] if self.affine else self._responding(point, hyper)[1]  # pyright: ignore

    def _responding(self, point: Point, hyper: Values):
        """Expected output, its slopes by slots and by corrected columns, and each term's column."""
        # Corrections of columns first, as every column may hang on them; then slots, the response, and back by the
        # chain rule: what corrects a column moves the output by ∂μ/∂column + Σ ∂μ/∂slot·∂(slot)/∂column.
        values = self.values(point.x, point.rows, hyper)
        moves: dict[str, np.ndarray] = {}
        if self.corrected:
            moves = {name: np.zeros(self.record.size) for name in self.corrected}
            for t, (column, _), value in zip(
                self.terms, self._columns(self.terms, hyper, {}), values, strict=True
            ):
                if t.slot in moves:
                    moves[t.slot] = moves[t.slot] + column * value
        columns = self._columns(self.terms, hyper, moves)
        sums: dict[str, Any] = {}
        for t, (column, _), value in zip(self.terms, columns, values, strict=True):
            if t.slot not in moves:
                sums[t.slot] = sums.get(t.slot, 0.0) + column * value
        mean, slopes = self.record.response(sums, moves)
        if moves:
            slopes = dict(slopes)
            for t, (_, by_move), value in zip(self.terms, columns, values, strict=True):
                for name, slope in by_move.items():
                    slopes[name] = slopes[name] + slopes[t.slot] * slope * value
        return mean, slopes, columns

    def linearise(self, point: Point, hyper: Values) -> Line:
        """Expected output and Jacobian at a point, output unit per reported unit."""
        if self.affine:
            return self._affine_line(point, hyper)
        mean, slopes, columns = self._responding(point, hyper)
        n = self.record.size
        jacobian, rows = np.zeros((n, self.size), order="F"), np.zeros((n, len(self.row_sd)))
        for t, (column, _) in zip(self.terms, columns, strict=True):
            self._into(t, slopes[t.slot] * column, jacobian, rows)
        return Line(mean, jacobian, rows)

    def _into(self, t: Term, column: np.ndarray, jacobian: np.ndarray, rows: np.ndarray) -> None:
        """Put a term's slopes where its coefficients stand: in x, or beside the readings."""
        if t.place == "x":
            self.place(t, column, jacobian)
        elif t.place == "row":
            rows[:, self._row_of[t.known.of, t.index]] = column

    def along(self, point: Point, v: Float[np.ndarray, "d"], i: int) -> Moved:
        """What one coordinate of φ moves."""
        name, ends = self.hypers[i].name, []
        for step in (SHIFT, -SHIFT):
            moved = v.copy()
            moved[i] += step
            ends.append(self.hyper(moved))
        # In general all columns may move; of an affine output only those of the effects that have the shape.
        if not self.affine or self.kinds[i] != "shape":
            up, down = (self.linearise(point, hyper) for hyper in ends)
            parts = zip(up, down, strict=True)
            mean, columns, rows = ((above - below) / (2 * SHIFT) for above, below in parts)
            which = np.flatnonzero(np.any(columns != 0, axis=0))
            return Moved(which, columns[:, which], mean, rows)
        slopes = self.slopes(point, ends[0])
        terms = [t for t in self.terms if name in t.known.shape_names]
        n = self.record.size
        made, mean, rows = np.zeros((n, self.size)), np.zeros(n), np.zeros((n, len(self.row_sd)))
        for t, (up, _), (down, _) in zip(
            terms, *(self._columns(terms, hyper, {}) for hyper in ends), strict=True
        ):
            column = slopes[t.slot] * (up - down) / (2 * SHIFT)
            self._into(t, column, made, rows)
            if t.place == "row":
                mean += column * point.rows[:, self._row_of[t.known.of, t.index]]
            else:
                mean += column * self.value(t, point.x, ends[0])
        every = np.arange(self.size)
        which = np.concatenate([every[:0], *(every[t.at] for t in terms if t.place == "x")])
        return Moved(which, made[:, which], mean, rows)

    def _affine_line(self, point: Point, hyper: Values) -> Line:
        """The same where the expected output is affine: columns that never change are put together once."""
        mean, slopes = self.record.affine  # pyright: ignore[reportGeneralTypeIssues]
        jacobian, rows = self._plain.copy(order="F"), np.zeros_like(point.rows)
        moving = [t for t in self.terms if t.place != "x" or t.known.shape_names]
        for t, (column, _) in zip(moving, self._columns(moving, hyper, {}), strict=True):
            column = slopes[t.slot] * column
            self._into(t, column, jacobian, rows)
            if t.place not in ("x", "row"):
                mean = mean + column * self.value(t, point.x, hyper)
        mean = mean + jacobian @ point.x + np.sum(rows * point.rows, axis=1)
        return Line(mean, jacobian, rows)

    @cached_property
    def _plain(self) -> Float[np.ndarray, "n p"]:
        """The Jacobian of an affine model, but for the columns that shapes move."""
        slopes = self.record.affine[1]  # pyright: ignore[reportOptionalSubscript]
        found = np.zeros((self.record.size, self.size), order="F")
        for slot, design in self.designs.items():
            found += slopes[slot][:, None] * design
        return found

    def place(self, term: Term, column: np.ndarray, table: np.ndarray) -> None:
        """Put a term's column into a table with one for each entry of x."""
        per = term.known.per
        put(column, None if per is None else self.record.codes[per], term.at.start, table)

    @cached_property
    def designs(self) -> dict[str, Float[np.ndarray, "n p"]]:
        """By slot, what x adds to it, of the terms whose columns never change; none where columns are corrected."""
        found: dict[str, np.ndarray] = {}
        for t in () if self.corrected else self.in_x:
            if not t.known.shape_names:
                matrix = found.setdefault(t.slot, np.zeros((self.record.size, self.size)))
                column = self.record.columns(t.known.columns, ())[:, t.index]
                self.place(t, column * t.factor, matrix)
        return found

    @cached_property
    def affine(self) -> bool:
        """Whether the expected output is affine in x and in the per-reading coefficients."""
        return not self.corrected and self.record.affine is not None


def put(
    column: Float[np.ndarray, "*b n"],
    codes: Int[np.ndarray, "n"] | None,
    start: int,
    table: Float[np.ndarray, "*b n p"],
) -> None:
    """Put a coefficient's column into a table from `start` on: in one column, or in that of each reading's member.

    Args:
        column: of the coefficient.
        codes: of the members, −1 for none; None where there is one coefficient for all.
        start: place of the first member.
        table: written to.
    """
    if codes is None:
        table[..., start] = column
        return
    known = np.flatnonzero(codes >= 0)
    table[..., known, start + codes[known]] = column[..., known]


def differences(f: Callable[[np.ndarray], Any], at: np.ndarray, step: Any) -> np.ndarray:
    """Slopes of a function by each coordinate, from both sides; one step, or one each."""
    shifts = np.diag(np.broadcast_to(step, at.shape))
    return np.array([(f(at + s) - f(at - s)) / (2 * s.sum()) for s in shifts])
