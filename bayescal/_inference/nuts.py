"""NumPyro's NUTS on a non-centred program of the model: a reference method, and an export of models to NumPyro."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np

from bayescal._core import deadline
from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._core.progress import track
from bayescal._data.measurements import Measurements
from bayescal._inference import trust
from bayescal._inference.density import Density
from bayescal._inference.laplace import NO_START, Mode, find_mode
from bayescal._inference.linear_model import fill_amplitudes
from bayescal._inference.marginal import Marginal
from bayescal._inference.method import Draws, Method, Outcome
from bayescal._inference.nuts_chains import Plan, run_kernel
from bayescal._inference.problem import Problem
from bayescal._inference.record import record_of
from bayescal._model import forward
from bayescal._model import prior as priors
from bayescal._model.frame import Frame, reference_of
from bayescal._model.model import Model
from bayescal._model.parameters import Layout, bind


class NUTS(Method):
    """Method that runs NumPyro's NUTS on all unknowns, non-centred for coefficients with a proper prior.

    Attributes:
        warmup, draws: iterations of each chain.
        chains: number of chains, run in parallel.
        dense: whether a dense mass matrix is adapted.
    """

    warmup: int = 1000
    draws: int = 1000
    chains: int = 4
    dense: bool = True
    name: ClassVar[str] = "nuts"

    def run(self, problem: Problem, seed: int, start: Any = NO_START) -> Outcome:
        layout = replace(problem.layout, promoted=())
        problem = Problem(layout, problem.record)
        frame, y = problem.record.frame, problem.record.y
        with deadline.suspend():
            mode = find_mode(problem, start=start)
        plan = Plan(self.warmup, self.draws, self.chains, self.dense)
        init_strategy = make_init_strategy(problem, mode)
        kernel = plan.kernel(build_program(layout, frame), init_strategy=init_strategy)
        deadline.current().defer_interrupt()
        try:
            with track("NUTS on every unknown"):
                chains = run_kernel(kernel, jax.random.key(seed), (y,), None, plan)
        except deadline.TimeIsUp as interrupt:
            return Marginal().approximate(problem, mode, seed, (), str(interrupt))
        sites = jax.jit(jax.vmap(jax.vmap(kernel.postprocess_fn((y,), {}))))(chains.draws)
        x, v = (np.asarray(sites[k]) for k in ("x", "v"))
        chains = chains._replace(draws=np.concatenate([x, v], axis=2))
        verdict = trust.assess_chains(chains, "NUTS", ())
        return Outcome(layout, Draws(x, v), mode, verdict, log_evidence=None)


def make_init_strategy(problem: Problem, mode: Mode) -> Callable[[Any], Any]:
    """Return a NumPyro initialisation strategy that draws starting points from a Gaussian about the mode.

    From prior draws, chains may end at another, far less probable mode: with noise on an input, a steep line increases
    the variance of the readings and is therefore near such a mode.
    """
    from numpyro.infer import init_to_median  # half a second that only these chains need

    # Of each site: value of a coordinate, its mean and sd.
    starts = dict[str, tuple[Callable[[Any], Any], Any, Any]]()
    _, conditional = Density(problem, mode.x, mode.flat, mode.v).condition_at(mode.v)
    if conditional is not None and np.all(np.isfinite(mode.covariance)):
        prior = problem.prior(problem.hyper(mode.v), mode.flat)
        scale = np.where(prior.weight > 0, np.maximum(prior.sd, 1e-300), 1.0)
        z = (mode.x - prior.weight * prior.mean) / scale
        sd = np.sqrt(np.diag(conditional.covariance))
        triples = zip(problem.hypers, mode.v, np.sqrt(np.diag(mode.covariance)), strict=True)
        starts |= {h.name: (h.prior.value, mean, sd_of_v) for h, mean, sd_of_v in triples}
        for b in problem.layout.x_blocks:
            name = b.name if b.coefficient.flat else f"{b.name}.standard"
            starts[name] = (jnp.asarray, z[b.x_slice], (sd / scale)[b.x_slice])

    def draw_start(site: Any) -> Any:
        if site["type"] != "sample" or site["name"] not in starts:
            return init_to_median(site, num_samples=50)
        value, mean, sd_of_v = starts[site["name"]]
        return value(mean + sd_of_v * jax.random.normal(site["kwargs"]["rng_key"], np.shape(mean)))

    return partial(draw_start)


def to_numpyro_distribution(prior: priors.Normal | priors.FlatLine | priors.Positive) -> Any:
    """Return a prior of an entry of φ as a NumPyro distribution of its value, in its own unit."""
    import numpyro.distributions as dist  # NumPyro only where its program is asked for

    match prior:
        case priors.Normal(mean=mean, sd=sd):
            return dist.Normal(mean, sd)
        case priors.LogNormal(median=median, sd=sd):
            return dist.LogNormal(np.log(median), sd)
        case priors.LogUniform(low=low, high=high):
            return dist.LogUniform(low, high)
        case priors.NumpyroPrior():
            return prior.distribution
        case priors.HalfNormal() | priors.HalfCauchy():
            return getattr(dist, type(prior).__name__)(prior.scale)
    is_real = isinstance(prior, priors.FlatLine)
    return dist.ImproperUniform(
        dist.constraints.real if is_real else dist.constraints.positive, (), ()
    )


def numpyro_program(model: Model, readings: Measurements) -> Callable[[Array], None]:
    """Return a model on its readings as a NumPyro program, a function of the output, for extension by the user.

    All coefficients with a proper prior are non-centred; see `build_program` for the sites of the program.
    `numpyro.infer.MCMC(NUTS(program)).run(key, readings["output"])` samples it.

    Raises:
        ModelError: readings lack a column, or have too few rows for the coefficients with a flat prior.
    """
    model.require(readings)
    record = record_of(model.instrument, readings, reference_of(readings))
    return build_program(bind(fill_amplitudes(model, readings, record), readings)[0], record.frame)


def build_program(layout: Layout, frame: Frame) -> Callable:
    """Return the model as a NumPyro program, a function of the output; coefficients of proper prior are non-centred.

    Its sites are hyper-parameters and coefficients with a flat prior (less their origin), by name in their units; the
    deviation of each other coefficient from its prior mean in prior standard deviations (of a group: the between-group
    one), as `name.standard`; the deterministic vectors `x` and `v`; and the likelihood as a factor.
    """
    import numpyro
    import numpyro.distributions as dist

    def model(y: Array) -> None:
        values, v = {}, []
        for h in layout.hypers:
            values[h.name] = numpyro.sample(h.name, to_numpyro_distribution(h.prior))
            v.append(h.prior.coordinate(jnp.asarray(values[h.name])))
        v = jnp.stack(v) if v else jnp.zeros(0)
        values.update({name: jnp.asarray(value) for name, value in layout.model.fixed})
        x = []
        for b in layout.x_blocks:
            c = b.coefficient
            if c.flat:
                flat_prior = dist.ImproperUniform(dist.constraints.real_vector, (), (b.size,))
                coefficients = numpyro.sample(b.name, flat_prior)
            else:
                z = numpyro.sample(
                    f"{b.name}.standard", dist.Normal(0.0, 1.0).expand([b.size]).to_event(1)
                )
                sd = c.size if b.group_sd_name is None else values[b.group_sd_name]
                coefficients = b.mean + sd * z
            x.append(coefficients)
        x = jnp.concatenate(x) if x else jnp.zeros(0)
        numpyro.deterministic("x", x)
        numpyro.deterministic("v", v)
        log_densities = forward.log_likelihood(layout, frame, y, x, values)
        numpyro.factor("readings", jnp.sum(log_densities))

    return model
