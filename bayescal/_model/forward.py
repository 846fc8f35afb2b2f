"""The composed model in JAX: expected output and Jacobian, log density, simulation.

Everything here is a pure JAX function of a `Layout` (static), a `Frame`, and values.
"""

from __future__ import annotations

from jaxtyping import Float

from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._model import composition
from bayescal._model.frame import Frame
from bayescal._model.noise_law import in_time, log_density_beside
from bayescal._model.parameters import Layout
from bayescal._model.terms import Sizes, Term, terms_of

Values = dict[str, Float[Array, "..."]]


def hyper_values(layout: Layout, v: Float[Array, "d"]) -> Values:
    """Return the entries of φ at coordinate v, by name, in reported units; fixed ones included."""
    values = {h.name: h.prior.value(v[i]) for i, h in enumerate(layout.hypers)}
    return {**{name: jnp.asarray(value) for name, value in layout.model.fixed}, **values}


def hyper_log_prior(layout: Layout, v: Float[Array, "d"]) -> Float[Array, ""]:
    """Return the log prior density of φ in its coordinates."""
    return sum((h.prior.log_density(v[i]) for i, h in enumerate(layout.hypers)), jnp.zeros(()))


def prior_mean(layout: Layout) -> Float[Array, "p"]:
    return jnp.asarray(layout.of_x([b.mean for b in layout.x_blocks]))


def prior_sd(
    layout: Layout, hyper: Values, flat: Float[Array, "p"] | float = 1.0
) -> Float[Array, "p"]:
    """Return the prior standard deviation of x given φ; where the prior is flat, the scale `flat` of its column."""
    sd = Sizes(terms_of(layout.x_blocks)[0], layout.model.effects, layout.size).at(hyper)
    return jnp.where(prior_weight(layout) > 0, sd, flat * sd)


def prior_weight(layout: Layout) -> Float[Array, "p"]:
    """Return 1 where the prior of x is proper, 0 where it is flat (p,)."""
    return jnp.asarray(layout.of_x([float(not b.coefficient.flat) for b in layout.x_blocks]))


def composed(
    layout: Layout, frame: Frame, x: Array, hyper: Values, sloped: bool = False
) -> tuple[composition.Traced, tuple[Term, ...], composition.Composed]:
    """Compose the model at a point; return its source, its terms and their sums; `sloped`: with slopes."""
    source = composition.Traced(layout.model.instrument, frame)
    terms, _ = terms_of(layout.blocks, source)
    values = [composition.value(source, t, x, hyper) for t in terms]
    return source, terms, composition.compose(source, terms, values, hyper, sloped)


def linearise(
    layout: Layout, frame: Frame, x: Float[Array, "p"], hyper: Values
) -> composition.Linearised:
    """Return the expected output and the Jacobian at a point, output unit per reported unit."""
    return composition.linearised(*composed(layout, frame, x, hyper, sloped=True))


def with_inputs(
    layout: Layout, frame: Frame, x: Float[Array, "p"], hyper: Values
) -> tuple[Float[Array, "n"], Float[Array, "n"] | None]:
    """Return the expected output, and the variance of each reading from noise on inputs; None where there is none."""
    inputs = any(b.place == "input" for b in layout.blocks)
    source, terms, sums = composed(layout, frame, x, hyper, sloped=inputs)
    if not inputs:
        return composition.expected(source, sums), None
    line = composition.linearised(source, terms, sums)
    return line.mean, composition.variance_of_inputs(terms, line)


def log_likelihood(
    layout: Layout, frame: Frame, y: Float[Array, "n"], x: Float[Array, "p"], hyper: Values
) -> Float[Array, "n"]:
    """Return the log density of each reading given every unknown; in the order of time under correlated noise."""
    noise, (expected, extra) = layout.model.noise, with_inputs(layout, frame, x, hyper)
    # Where the order matters there is no noise on inputs, which would have to follow it.
    ordered, y, expected = in_time(noise, frame, y, expected)
    return log_density_beside(noise, y, expected, extra, hyper, ordered)


def log_prior_x(layout: Layout, x: Float[Array, "p"], hyper: Values) -> Float[Array, ""]:
    """Return the log prior density of x given φ; flat ones contribute zero."""
    sd, weight = prior_sd(layout, hyper), prior_weight(layout)
    z = (x - prior_mean(layout)) / sd
    return -0.5 * jnp.sum(weight * (z**2 + 2 * jnp.log(sd) + jnp.log(2 * jnp.pi)))


def draw_readings(layout: Layout, frame: Frame, x: Array, v: Array, key: Array) -> Array:
    """Draw readings from the model's equation and noise, noise on inputs to first order."""
    hyper, noise = hyper_values(layout, v), layout.model.noise
    expected, extra = with_inputs(layout, frame, x, hyper)
    if extra is not None:
        key, subkey = jax.random.split(key)
        expected = expected + jnp.sqrt(extra) * jax.random.normal(subkey, expected.shape)
    ordered, expected = in_time(noise, frame, expected)
    drawn = noise.sample(key, expected, hyper, ordered)
    return drawn if noise.independent else jnp.zeros_like(drawn).at[frame.order].set(drawn)
