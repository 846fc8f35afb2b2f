"""Fit a NumPyro program of the user's own: what is Gaussian in it is integrated out, as in bayescal's own models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayescal._core.errors import ModelError, NotConverged
from bayescal._core.importance_weights import effective_size, resample, smoothed
from bayescal._core.jax_setup import spare_memory_maps
from bayescal._core.progress import stage
from bayescal._inference import nuts_chains, trust
from bayescal._inference.marginal import Marginal
from bayescal._inference.method import CHAINS, Method, Verdict, by_chain
from bayescal._inference.nuts import NUTS, sampled
from bayescal._numpyro import marginal_density
from bayescal._numpyro.gaussian_sites import Split, split
from bayescal._numpyro.program_fit import ProgramFit, tree_of
from bayescal._numpyro.survey import survey
from bayescal._numpyro.trace import TracedProgram, draw_trace

WIDE = 30  # coordinates, above which importance sampling is not tried
MANY = 1000  # readings that cost anew at each proposal, above which fewer are made
MOST_LEFT_OUT = (
    0.01  # of the log density by the Gaussian form, root mean square, below which draws stand
)
NOT_GAUSSIAN = (
    "The density is Gaussian at the points that were tried, but not where the readings point to: "
    "NumPyro's NUTS on every unknown."
)


@dataclass(frozen=True)
class _Drawn:
    """What a way of sampling hands back: draws (chains, draws, …) by site."""

    values: dict[str, np.ndarray]
    verdict: Verdict
    log_evidence: tuple[float, float | None] | None = None


def fit_program(
    model: Callable, readings: Any, method: Method | None = None, *, seed: int, strict: bool
) -> ProgramFit:
    """Fit a NumPyro program; `bc.fit` says how.

    Raises:
        ModelError: the program or the method cannot be used, or a reading is not a finite number.
        NotConverged: the verdict is not good; carries the result.
    """
    spare_memory_maps()
    method = Marginal() if method is None else method
    if not isinstance(method, (Marginal, NUTS)):
        raise ModelError(
            f"A NumPyro program is fitted by Marginal() or NUTS(), not by {type(method).__name__}()"
        )
    with stage("tracing the program"):
        program = survey(model, readings)
        observed = _observed(program)
        keep = method.promote if isinstance(method, Marginal) else [s.name for s in program.latent]
        divided = split(program, keep)
    if isinstance(method, Marginal) and divided.inside:
        drawn = _marginal(divided, method, seed)
    else:
        drawn = _plain(divided, method, seed, _why_plain(divided, method))
    whole = drawn.verdict.sampler == "NUTS"
    fitted = ProgramFit(
        name=program.name,
        tree=tree_of(program, drawn.values, observed),
        verdict=drawn.verdict,
        method=method.name,
        seed=seed,
        log_evidence=None if program.improper else drawn.log_evidence,
        marginalised=() if whole else tuple(s.name for s in divided.inside),
        sampled=tuple(s.name for s in (program.latent if whole else divided.outside)),
    )
    if strict and not drawn.verdict.ok:
        raise NotConverged(
            f"The fit of {program.name!r} did not converge: {' '.join(drawn.verdict.reasons)} "
            "(strict=False returns it all the same.)",
            fitted,
        )
    return fitted


def _observed(program: TracedProgram) -> dict[str, np.ndarray]:
    """Values of the observed sites, checked."""

    def values(key):
        made = draw_trace(program.run, key)
        return {s.name: made[s.name]["value"] for s in program.observed if s.law != "Unit"}

    found = jax.tree.map(np.asarray, jax.jit(values)(jax.random.key(0)))
    for name, value in found.items():
        if not np.all(np.isfinite(value)):
            place = [int(i) for i in np.argwhere(~np.isfinite(np.atleast_1d(value)))[0]]
            raise ModelError(
                f"Observed site {name!r} of {program.name!r} holds {np.atleast_1d(value)[tuple(place)]} at "
                f"{place}: leave out readings that are missing"
            )
    return found


def _why_plain(divided: Split, method: Method) -> tuple[str, ...]:
    if isinstance(method, NUTS):
        return ()
    if divided.program.loops:
        why = "The program has a scan or another loop of NumPyro, which is not looked into"
    elif any(site.gaussian for site in divided.program.latent):
        why = "No Gaussian site can be integrated out"
    else:
        why = "No unknown site is Normal or MultivariateNormal"
    return (*divided.reasons, f"{why}: NumPyro's NUTS on every unknown.")


def _marginal(divided: Split, method: Marginal, seed: int) -> _Drawn:
    """Importance sampling of what is not integrated out; NUTS where that fails."""
    inside = ", ".join(s.name for s in divided.inside)
    notes = (f"Integrated out in closed form: {inside}.", *divided.reasons)
    keys = jax.random.split(jax.random.key(seed), 3)
    with stage("finding the mode"):
        mode = marginal_density.compiled_mode(divided, keys[0])
    if not divided.dim:
        return _closed(divided, mode, method, keys[1], seed, notes)
    if method.sampler == "nuts":
        return _chains(divided, mode, method, seed, notes)
    if divided.dim > WIDE:
        why = f"{divided.dim} coordinates are too many for importance sampling"
        return _chains(divided, mode, method, seed, (*notes, f"{why}: NUTS on them."))
    with stage("sampling"):
        proposals = method.proposals or (2048 if _anew(divided) > MANY else 8192)
        found = marginal_density.sample(divided, mode, keys[1], proposals, method.rounds)
        log_weight = np.asarray(found.log_weight)
        weights, k_hat = smoothed(log_weight)
    if why := trust.unevenness(weights, k_hat, enough=min(trust.ENOUGH, proposals / 4)):
        notes = (*notes, f"Importance weights were uneven ({why}): NUTS instead.")
        return _chains(divided, mode, method, seed, notes)
    count = CHAINS * max(1, int(min(method.draws, effective_size(weights))) // CHAINS)
    pick = resample(weights, count, seed)
    relative = np.exp(log_weight - log_weight.max())
    evidence = float(np.log(relative.mean()) + log_weight.max())
    error = float(np.std(relative / relative.mean()) / np.sqrt(proposals))
    verdict = trust.weights_verdict(weights, k_hat, notes)
    values = marginal_density.values_of(divided, found.x[pick], found.v[pick])
    return _Drawn(_by_chain(values), verdict, (evidence, error))


def _closed(divided: Split, mode, method: Marginal, key, seed: int, notes) -> _Drawn:
    """Independent draws, where nothing is left to sample."""
    count = CHAINS * max(1, method.draws // CHAINS)
    x, v, evidence, left_out = marginal_density.draws_back(
        divided, mode, jnp.zeros((count, 0)), key
    )
    if not _gaussian(left_out):
        return _plain(divided, method, seed, (*notes[1:], NOT_GAUSSIAN))
    verdict = Verdict(True, notes=notes, sampler="independent draws", ess=float(count))
    values = _by_chain(marginal_density.values_of(divided, x, v))
    return _Drawn(values, verdict, (float(evidence[0]), 0.0))


def _gaussian(left_out) -> bool:
    """Whether the density is Gaussian in what was integrated out wherever the draws lie."""
    return bool(np.sqrt(np.mean(np.clip(np.asarray(left_out), -1e3, 1e3) ** 2)) < MOST_LEFT_OUT)


def _anew(divided: Split) -> int:
    """Number of readings that are not summed up once."""
    return sum(
        int(np.prod(s.shape)) for s in divided.program.observed if s.name not in divided.fixed
    )


def _chains(divided: Split, mode, method: Marginal, seed: int, notes: tuple[str, ...]) -> _Drawn:
    """NUTS on what is not integrated out; the rest drawn back."""
    k1, k2 = jax.random.split(jax.random.key(seed))
    log_density = marginal_density.density_of_u(divided, mode)
    with stage("NUTS on what is not Gaussian"):
        ran = nuts_chains.run(
            lambda u: log_density(u)[0],
            mode.v,
            mode.covariance,
            k1,
            warmup=500,
            draws=max(1, method.draws // CHAINS),
            chains=CHAINS,
            dense=divided.dim <= 2 * WIDE,
        )
        flat = ran.draws.reshape(-1, divided.dim)
        x, v, _, left_out = marginal_density.draws_back(divided, mode, flat, k2)
    if not _gaussian(left_out):
        return _plain(divided, method, seed, (*notes[1:], NOT_GAUSSIAN))
    verdict = trust.chain_verdict(ran, "NUTS on what is not integrated out", notes)
    values = marginal_density.values_of(divided, x, v)
    return _Drawn(_by_chain(values), verdict, (float(mode.log_evidence), None))


def _plain(divided: Split, method: Method, seed: int, notes: tuple[str, ...]) -> _Drawn:
    """NumPyro's own NUTS on the program as it is."""
    if not isinstance(method, NUTS):
        # pyright sees no fields of an equinox module through the isinstance above
        method = NUTS(draws=max(1, method.draws // CHAINS), chains=CHAINS)  # pyright: ignore
    program = divided.program
    size = sum(site.size for site in program.latent)
    dense = method.dense and size <= 2 * WIDE
    found, values = sampled(
        program.run,
        (),
        warmup=method.warmup,
        draws=method.draws,
        chains=method.chains,
        dense=dense,
        seed=seed,
    )
    flat = [jnp.reshape(a, (*a.shape[:2], -1)) for a in jax.tree.leaves(found.draws)]
    ran = nuts_chains.Chains(jnp.concatenate(flat, axis=2), found.divergences, found.steps)
    return _Drawn(
        {name: np.asarray(value) for name, value in values.items()},
        trust.chain_verdict(ran, "NUTS", notes),
    )


def _by_chain(values: dict) -> dict[str, np.ndarray]:
    return {name: by_chain(value) for name, value in values.items()}
