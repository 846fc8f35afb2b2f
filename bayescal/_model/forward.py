"""A model in JAX: expected output and Jacobian, log density, simulation.

All functions are pure JAX functions of a `Layout` (static), a `Frame`, and values.
"""

from __future__ import annotations

from jaxtyping import Float

from bayescal._core.lazy_jax import Array, jax, jnp
from bayescal._model import composition
from bayescal._model.frame import Frame
from bayescal._model.noise_law import compute_log_density, sort_by_time
from bayescal._model.parameters import Layout
from bayescal._model.terms import PriorDeviations, Term, build_terms

Values = dict[str, Float[Array, "..."]]


def prior_sd(
    layout: Layout, hyper: Values, flat_scales: Float[Array, "p"] | float = 1.0
) -> Float[Array, "p"]:
    """Return the prior standard deviation of x given φ (p,); `flat_scales` where the prior is flat."""
    terms, _ = build_terms(layout.x_blocks)
    sd = PriorDeviations(terms, layout.model.effects, layout.size).evaluate(hyper)
    return jnp.where(layout.weight_of_x > 0, sd, flat_scales * sd)


def compose_at(
    layout: Layout, frame: Frame, x: Array, hyper: Values, with_grad: bool = False
) -> tuple[composition.TracedColumns, tuple[Term, ...], composition.ResponseArguments]:
    """Return the column source, the terms, and the arguments of the response at (x, φ)."""
    source = composition.TracedColumns(layout.model.instrument, frame)
    terms, _ = build_terms(layout.blocks, source)
    values = [composition.expand_coefficient(source, t, x, hyper) for t in terms]
    return source, terms, composition.compose(source, terms, values, hyper, with_grad)


def linearise(
    layout: Layout, frame: Frame, x: Float[Array, "p"], hyper: Values
) -> composition.Linearisation:
    """Return the expected output and its Jacobian at (x, φ), output unit per reported unit."""
    return composition.linearise_output(*compose_at(layout, frame, x, hyper, with_grad=True))


def predict_moments(
    layout: Layout, frame: Frame, x: Float[Array, "p"], hyper: Values
) -> tuple[Float[Array, "n"], Float[Array, "n"] | None]:
    """Return the expected output (n,), and each reading's variance due to noisy inputs (n,), or None without these."""
    has_noisy_inputs = any(b.place == "input" for b in layout.blocks)
    source, terms, composed = compose_at(layout, frame, x, hyper, with_grad=has_noisy_inputs)
    if not has_noisy_inputs:
        return source.response(composed.slots, composed.shifts), None
    linearisation = composition.linearise_output(source, terms, composed)
    return linearisation.mean, composition.compute_input_variance(terms, linearisation)


def log_likelihood(
    layout: Layout, frame: Frame, y: Float[Array, "n"], x: Float[Array, "p"], hyper: Values
) -> Float[Array, "n"]:
    """Return the log density of each reading given x and φ (n,), sorted by time within runs if noise is correlated."""
    noise, (expected, input_variance) = layout.model.noise, predict_moments(layout, frame, x, hyper)
    # Correlated noise is never combined with noisy inputs, so that `input_variance` need not be sorted.
    ordered, y, expected = sort_by_time(noise, frame, y, expected)
    return compute_log_density(noise, y, expected, input_variance, hyper, ordered)


def log_prior_x(layout: Layout, x: Float[Array, "p"], hyper: Values) -> Float[Array, ""]:
    """Return the log prior density of x given φ; flat priors contribute zero."""
    sd, weight = prior_sd(layout, hyper), layout.weight_of_x
    z = (x - layout.mean_of_x) / sd
    return -0.5 * jnp.sum(weight * (z**2 + 2 * jnp.log(sd) + jnp.log(2 * jnp.pi)))


def draw_readings(layout: Layout, frame: Frame, x: Array, v: Array, key: Array) -> Array:
    """Draw readings (n,) given x and the coordinates v of φ; noise on inputs is included to first order."""
    hyper, noise = layout.hyper(v), layout.model.noise
    expected, input_variance = predict_moments(layout, frame, x, hyper)
    if input_variance is not None:
        key, subkey = jax.random.split(key)
        expected = expected + jnp.sqrt(input_variance) * jax.random.normal(subkey, expected.shape)
    ordered, expected = sort_by_time(noise, frame, expected)
    readings = noise.sample(key, expected, hyper, ordered)
    return readings if noise.independent else jnp.zeros_like(readings).at[frame.order].set(readings)
