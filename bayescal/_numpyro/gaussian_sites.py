"""Which sites of a program can be integrated out: found by trying, at random points.

A Gaussian site can be integrated out if, given all that is sampled, every Gaussian density's location is affine in
it, no scale depends on it, and no other density does. Differences of finite steps see kinks and steps of a
function, derivatives at both ends of a step see weak curvature beside a large constant. Points are drawn from the
prior, and near the origin, where a function that overflows under a wide prior is finite.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bayescal._core.errors import ModelError
from bayescal._core.parallel import over
from bayescal._numpyro.trace import (
    Densities,
    Site,
    TracedProgram,
    densities,
    draw_trace,
    free_of,
    trace_at,
)

SEED = (
    20261121  # of the points; not the fit's, so that what is integrated out never depends on that
)
POINTS = 3  # of each kind
SAME = 1e-8  # of the largest value: what a step may leave by rounding
STRAIGHT = 1e-9  # of the slope: by how much slopes at both ends of a step may differ


class Split(NamedTuple):
    """How the unknowns of a program are divided.

    Attributes:
        program: whose.
        inside: integrated out; their values, one after the other, are x.
        outside: sampled; their unconstrained coordinates, one after the other, are v.
        fixed: observed Normal sites whose location depends on nothing in v and whose readings share one scale.
        separate: no prior of a sampled site depends on x, so that v can be drawn from its prior.
        reasons: why Gaussian sites are sampled, each a sentence.
    """

    program: TracedProgram
    inside: tuple[Site, ...]
    outside: tuple[Site, ...]
    fixed: tuple[str, ...]
    separate: bool
    reasons: tuple[str, ...]

    @property
    def size(self) -> int:
        return sum(site.size for site in self.inside)

    @property
    def dim(self) -> int:
        return sum(site.size for site in self.outside)

    def trace(self, x: Float[Array, "p"], v: Float[Array, "d"]):
        return trace_at(self.program, shaped(self.inside, x), shaped(self.outside, v))

    def densities(self, x: Float[Array, "p"], v: Float[Array, "d"]) -> Densities:
        return densities(self.program, self.trace(x, v))

    def draw_v(self, key: Array) -> Float[Array, "d"]:
        """Coordinates of what is sampled, from their prior."""
        made = draw_trace(self.program.run, key)
        return raveled(self.outside, free_of(self.program, made))


def shaped(sites: Sequence[Site], vector: Float[Array, "d"]) -> dict[str, Array]:
    found, start = {}, 0
    for site in sites:
        found[site.name] = vector[start : start + site.size].reshape(site.free)
        start += site.size
    return found


def raveled(sites: Sequence[Site], values: Mapping[str, Array]) -> Float[Array, "d"]:
    parts = [jnp.ravel(values[site.name]) for site in sites]
    return jnp.concatenate(parts) if parts else jnp.zeros(0)


def split(program: TracedProgram, keep: Sequence[str] | None = None) -> Split:
    """Decide what is integrated out.

    Args:
        program: traced.
        keep: names of sites to sample in any case.

    Raises:
        ModelError: a name in `keep` is no unknown of the program.
    """
    keep = tuple(keep or ())
    names = [site.name for site in program.latent]
    for name in keep:
        if name not in names:
            raise ModelError(
                f"promote: {program.name!r} has no unknown site {name!r}; it has: {', '.join(names)}"
            )
    candidates = [s for s in program.latent if s.gaussian and s.size and s.name not in keep]
    if program.loops or not candidates:
        return Split(program, (), program.latent, fixed=(), separate=True, reasons=())
    study = _study(program, tuple(candidates))
    out, reasons = _expelled(program, candidates, study)
    inside = tuple(s for s in candidates if s.name not in out)
    outside = tuple(s for s in program.latent if s not in inside)
    inner = [i for i, s in enumerate(candidates) if s in inside]
    moving = [i for i, s in enumerate(candidates) if s not in inside]
    at = {name: i for i, name in enumerate(study.names)}
    fixed = tuple(
        s.name
        for s in program.observed
        if s.name in study.single
        and not study.by_rest[at[s.name]]
        and not any(study.placed[i, at[s.name]] for i in moving)
    )
    moved = study.scaled.copy()
    moved[:, : study.placed.shape[1]] |= study.placed
    apart = not any(moved[i, at[s.name]] for i in inner for s in outside)
    return Split(program, inside, outside, fixed=fixed, separate=apart, reasons=tuple(reasons))


class _Study(NamedTuple):
    """What was seen: (candidates, sites) and (candidates, candidates, sites) of truths."""

    names: tuple[str, ...]  # of the sites, as in the last axis
    single: tuple[str, ...]  # Normal sites whose entries share one scale
    placed: (
        np.ndarray
    )  # the site's location moves with the candidate; Gaussian sites alone, which come first
    scaled: np.ndarray  # its scale, or its density if it is not Gaussian, moves
    nonlinear: np.ndarray  # its location is not affine in the two
    by_rest: np.ndarray  # its location moves with the sites that are no candidates


def _study(program: TracedProgram, candidates: tuple[Site, ...]) -> _Study:
    rest = tuple(s for s in program.latent if s not in candidates)
    size = sum(s.size for s in candidates)
    owner = np.repeat(np.arange(len(candidates)), [s.size for s in candidates])
    masks = jnp.asarray(owner == np.arange(len(candidates))[:, None], dtype=float)
    pairs = [(i, j) for i in range(len(candidates)) for j in range(i, len(candidates))]
    names: list[str] = []

    def parts(x, v):
        found = densities(program, trace_at(program, shaped(candidates, x), shaped(rest, v)))
        names[:] = [*found.gaussian, *found.other]
        places = [jnp.ravel(f.rest) for f in found.gaussian.values()]
        scales = [jnp.ravel(f.root) for f in found.gaussian.values()]
        return places, [*scales, *[jnp.ravel(o) for o in found.other.values()]]

    def point(key, tame):
        free = free_of(program, draw_trace(program.run, key, tame))
        return raveled(candidates, free), raveled(rest, free)

    def one_place(three):
        (x, x1, x2), (v, v1, _) = three
        h, k = x1 - x, x2 - x
        # The program is evaluated at two places of this function only: each costs a compilation.
        steps = jnp.concatenate([x[None], x[None], x + masks * h])
        others = jnp.stack([v, v1, *[v] * len(candidates)])
        places, scales = over(lambda a: parts(*a), (steps, others), room)
        here, same = [p[0] for p in places], [s[0] for s in scales]
        placed = jnp.stack([_differ(here, [p[i] for p in places]) for i in range(1, len(steps))])
        scaled = jnp.stack([_differ(same, [s[i] for s in scales]) for i in range(2, len(steps))])
        equal = jnp.stack([jnp.ptp(s) == 0 for s in same[: len(here)]])

        def together(pair):
            a, b = masks[pair[0]] * h, masks[pair[1]] * k
            corners = jnp.stack([x, x + a, x + b, x + a + b])
            push = jax.vmap(lambda at: jax.jvp(lambda x: parts(x, v)[0], (at,), (b,)))
            return _nonlinear(*push(corners))

        return scaled, placed[1:], over(together, jnp.asarray(pairs), room), placed[0], equal

    @jax.jit
    def everywhere(key):
        keys = jax.random.split(key, (2, POINTS, 3))
        kinds = [
            jax.vmap(jax.vmap(lambda k, tame=tame: point(k, tame)))(keys[int(tame)])
            for tame in (False, True)
        ]
        x, v = jax.tree.map(lambda *a: jnp.moveaxis(jnp.concatenate(a), 1, 0), *kinds)
        return jax.lax.map(one_place, (tuple(x), tuple(v)))

    longest = max(int(np.prod(s.shape)) for s in (*program.latent, *program.observed))
    room = max(1, int(5e5) // max(1, longest + size))
    seen = jax.tree.map(np.asarray, everywhere(jax.random.key(SEED)))
    return _understood(program, len(candidates), pairs, names, *seen)


def _understood(
    program: TracedProgram,
    count: int,
    pairs: list[tuple[int, int]],
    names: list[str],
    scaled: np.ndarray,
    placed: np.ndarray,
    nonlinear: np.ndarray,
    rest_moves: np.ndarray,
    equal: np.ndarray,
) -> _Study:
    """What was seen at all points together."""
    # 1 seen, 0 not seen, −1 not finite there; what is finite nowhere counts as seen.
    scaled, placed, nonlinear, rest_moves = (
        _seen(a) for a in (scaled, placed, nonlinear, rest_moves)
    )
    gaussian = placed.shape[1]
    square = np.zeros((count, count, gaussian), bool)
    for (i, j), row in zip(pairs, nonlinear, strict=True):
        square[i, j] = square[j, i] = row
    normal = [s.name for s in program.observed if s.law == "Normal" and s.gaussian]
    single = [n for i, n in enumerate(names[:gaussian]) if np.all(equal[:, i])]
    single = tuple(n for n in single if n in normal)
    return _Study(
        names=tuple(names),
        single=single,
        placed=placed,
        scaled=scaled,
        nonlinear=square,
        by_rest=rest_moves,
    )


def _seen(verdicts: np.ndarray) -> np.ndarray:
    return np.any(verdicts == 1, axis=0) | np.all(verdicts == -1, axis=0)


def _differ(here: list[Array], there: list[Array]) -> Array:
    """For each site whether anything in it moved (1), did not (0), or cannot be told (−1)."""
    found = []
    for a, b in zip(here, there, strict=True):
        limit = STRAIGHT * (jnp.abs(a) + jnp.abs(b))
        moved = (jnp.abs(a - b) > limit) & jnp.isfinite(a) & jnp.isfinite(b)
        blind = ~(jnp.isfinite(a) & jnp.isfinite(b)) & ~(a == b)
        found.append(jnp.where(jnp.any(moved), 1, jnp.where(jnp.any(blind), -1, 0)))
    return jnp.stack(found) if found else jnp.zeros(0, int)


def _nonlinear(places: list[Array], slopes: list[Array]) -> Array:
    """For each Gaussian site whether its location is not affine: values and slopes at x, x + a, x + b, x + a + b."""
    found = []
    for at, along in zip(places, slopes, strict=True):
        size = jnp.max(jnp.abs(at))
        step = jnp.max(jnp.abs(at[3] - at[2] - at[1] + at[0]))
        steep = jnp.max(jnp.abs(along))
        turn = jnp.max(jnp.abs(along - along[0]))
        nonlinear = (step > SAME * size) | (turn > STRAIGHT * steep)
        found.append(jnp.where(jnp.isfinite(size + steep + step + turn), nonlinear, -1))
    return jnp.stack(found) if found else jnp.zeros(0, int)


def _expelled(
    program: TracedProgram, candidates: list[Site], study: _Study
) -> tuple[set[str], list[str]]:
    """Candidates that are sampled after all, and why."""
    out: set[str] = set()
    reasons = []
    laws = {s.name: s for s in (*program.latent, *program.observed)}

    def expel(i: int, why: str) -> None:
        if candidates[i].name not in out:
            out.add(candidates[i].name)
            reasons.append(f"{candidates[i].name!r} is sampled: {why}.")

    for i in range(len(candidates)):
        own = candidates[i].name
        for j, name in enumerate(study.names):
            if study.scaled[i, j] and laws[name].gaussian:
                expel(i, f"the scale of {name!r} depends on it")
            elif study.scaled[i, j]:
                law = "a factor" if laws[name].law == "Unit" else laws[name].law
                expel(i, f"{name!r} ({law}) depends on it and is not Gaussian")
            elif j < study.nonlinear.shape[2] and study.nonlinear[i, i, j] and name != own:
                expel(i, f"the location of {name!r} is not affine in it")
    clash = np.any(study.nonlinear, axis=2)
    np.fill_diagonal(clash, False)
    left = [i for i in range(len(candidates)) if candidates[i].name not in out]
    while True:
        counts = {i: sum(clash[i, j] for j in left) for i in left}
        worst = max(left, key=lambda i: (counts[i], -candidates[i].size), default=None)
        if worst is None or not counts[worst]:
            return out, reasons
        others = ", ".join(repr(candidates[j].name) for j in left if clash[worst, j])
        expel(
            worst, f"a location holds its product with {others}, or is nonlinear in both together"
        )
        left.remove(worst)
