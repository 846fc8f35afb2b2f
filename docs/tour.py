"""A tour in eight steps: a gyroscope's model written out, fitted, found wanting, mended and taken to firmware.

    python docs/tour.py        # half a minute; `cc` is the system's C compiler

Each step does by hand, in NumPyro or NumPy, what one call of bayescal does, and prints both.
"""

# %% 1. The readings

# A MEMS gyroscope stands still in a climate chamber. Its temperature goes up and down in steps,
# three times over; between the runs it is switched off. Its output is what it would call a rate
# of turn, though nothing turns: its *bias*, in °/s. The gyroscope is simulated, so that we know
# what it does. Two things are hidden in it: at each switch-on the bias comes back a little
# different (standard deviation 0.05 °/s), and over temperature it bends (0.0002 °/s/°C²).

from __future__ import annotations

import subprocess
import tempfile
from itertools import pairwise
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import numpyro
import numpyro.distributions as dist
from jax import random
from numpyro.infer import MCMC, NUTS, init_to_median
from scipy.special import logsumexp

import bayescal as bc
from bayescal_models import mems_gyro

HIDDEN = {"bias.run": 0.05, "bias.temperature_quadratic": 2e-4}
readings = mems_gyro.simulate(HIDDEN, seed=1)
print(readings)

# A real test comes from a file in the same way: `bc.read("test.csv", mems_gyro.INSTRUMENT)`. What
# follows needs the columns as arrays: temperature T in °C, output y in °/s, and the run of each
# reading as 0, 1 or 2.

T, y = readings["temperature"], readings["output"]
runs, run = readings.groups("run")
T0 = np.round(T.mean())  # °C; where the constant and the slope are told apart best

# %% 2. The model, written out

# The customary model of such a bias is a line over temperature, and we add an offset for each
# run, since switch-ons differ:
#
#     y_i = c0 + c1·(T_i − T0) + d_run(i) + e_i,      d_j ~ N(0, s²),      e_i ~ N(0, σ²)
#
# It is *hierarchical*: how much runs differ, s, is an unknown as well, learned from the runs that
# there are, and what a run in the field will do follows from it. In NumPyro a line of code says a
# line of this. The widths are prior knowledge: what a bias, a slope and a scatter of this kind of
# sensor plausibly are.


def gyroscope(T, run, output=None):
    """Temperature, °C (n,); the run of each reading, 0 to 2; output, °/s (n,), or None to simulate."""
    c0 = numpyro.sample("bias.constant", dist.Normal(0.0, 50.0))  # °/s
    c1 = numpyro.sample("bias.temperature", dist.Normal(0.0, 0.05))  # °/s/°C
    s = numpyro.sample("bias.run.group_sd", dist.HalfNormal(0.05))  # °/s
    with numpyro.plate("runs", len(runs)):
        d = s * numpyro.sample("standard", dist.Normal(0.0, 1.0))  # in units of s: no funnel
    sigma = numpyro.sample("noise.white", dist.HalfCauchy(0.1))  # °/s
    numpyro.sample("output", dist.Normal(c0 + c1 * (T - T0) + d[run], sigma), obs=output)


# The posterior by the No-U-Turn sampler: nothing is approximated but by the number of draws.

numpyro.enable_x64()
kernel = NUTS(gyroscope, dense_mass=True, target_accept_prob=0.9, init_strategy=init_to_median)
chain = MCMC(kernel, num_warmup=600, num_samples=2000, progress_bar=False)
chain.run(random.key(0), jnp.asarray(T), jnp.asarray(run), jnp.asarray(y))
drawn = {name: np.asarray(values) for name, values in chain.get_samples().items()}
for name in ("bias.constant", "bias.temperature", "bias.run.group_sd", "noise.white"):
    print(f"{name:18s} {drawn[name].mean():9.5f} ± {drawn[name].std():.5f}")

# %% 3. The same by bc.fit

# In bayescal a model is an instrument and a sum of named effects. `baseline()` is the line, and
# `bias.run` the offset of each run. Names, widths, and the *slot* that each effect adds to (here the
# bias) are one table in the instrument's `model.py` (`models/bayescal_models/mems_gyro/model.py`).

model = mems_gyro.INSTRUMENT.baseline() + "bias.run"
print(model)

# `bc.fit` uses what a sampler does not know. Given s and σ the model is linear and Gaussian in
# c0, c1 and d, so these are integrated out in closed form, and two numbers are left to sample, by
# importance sampling about their mode.

fit = bc.fit(model, readings)
for name in ("bias.constant", "bias.temperature", "bias.run.group_sd", "noise.white"):
    own = fit.samples(name)
    print(f"{name:18s} {own.mean():9.5f} ± {own.std():.5f}")
print(fit.verdict)

# %% 4. Both agree

# The difference of the means in standard deviations, and the ratio of the widths.

for name in ("bias.constant", "bias.temperature", "bias.run.group_sd", "noise.white"):
    own, other = fit.samples(name), drawn[name]
    apart, ratio = (own.mean() - other.mean()) / other.std(), own.std() / other.std()
    print(f"{name:18s} means {apart:+.2f} sd apart, widths in the ratio {ratio:.2f}")

# %% 5. Where the model fails

# A model is tried on what it leaves over. Residuals by temperature, in five parts of its range:

c0, c1, d = (
    fit.samples(f"bias.{name}").mean(axis=0) for name in ("constant", "temperature", "run")
)
residual = y - (c0 + c1 * (T - T0) + d[run])
edges = np.linspace(T.min(), T.max() + 1e-9, 6)
for low, high in pairwise(edges):
    there = residual[(low <= T) & (high > T)]
    error = residual.std() / np.sqrt(there.size)
    print(f"{low:2.0f} to {high:2.0f} °C  mean {there.mean():+.3f} ± {error:.3f} °/s")

# High at both ends, low in the middle: a line has been laid through a parabola. `bc.check` asks
# the same of every recorded quantity, and gives the evidence that the residuals depend on it.

print(bc.check(fit))

# %% 6. One candidate by hand

# Is c2·(T − T0)² missing? Two models are weighed by the probability that each gave to what was
# read, its *evidence*: a model that could have explained anything has spent its probability
# elsewhere. Given s and σ, with the columns Φ of all coefficients and the prior variances P, the
# output is Gaussian, y ~ N(0, Φ P Φᵀ + σ²·1), and all that the readings say is in their *Gram
# matrix*: the products of the columns with each other, and with y. With it no matrix has the size
# of the record:
#
#     ln p(y | s, σ) = −n/2·ln 2πσ² − ½·ln|P| − ½·ln|A| − ½·(yᵀy/σ² − bᵀA⁻¹b/σ⁴),   A = ΦᵀΦ/σ² + P⁻¹,  b = Φᵀy
#
# (The matrix determinant lemma, and the Woodbury identity.)

t = T - T0
line = np.column_stack([np.ones_like(t), t, *(run == j for j in range(len(runs)))])  # (n, 5)
bent = np.column_stack([line, t**2])  # (n, 6)
gram = bent.T @ bent
print("Gram matrix: the columns 1, T − T0, three runs, (T − T0)²")
for row in gram:
    print("  ".join(f"{value:9.0f}" for value in row))

# How much of the new column can the others not imitate? What is left of its length after they are
# taken out of it:

seen = gram[5, 5] - gram[5, :5] @ np.linalg.pinv(gram[:5, :5]) @ gram[:5, 5]
print(f"of (T − T0)² the others leave {seen / gram[5, 5]:.3f}")

# s and σ are not known. Their priors are those of the model above, and their integral is a sum
# over a grid in ln s and ln σ.


def half_normal(x, scale):
    """Logarithm of its density at x > 0, both in one unit."""
    return 0.5 * np.log(2 / np.pi) - np.log(scale) - 0.5 * (x / scale) ** 2


def half_cauchy(x, scale):
    """Logarithm of its density at x > 0, both in one unit."""
    return np.log(2 / np.pi) - np.log(scale) - np.log1p((x / scale) ** 2)


def log_evidence(columns, sizes):
    """ln p(y), s and σ integrated out.

    Columns (n, p) and the prior standard deviations of their coefficients (p,), where 0 stands for s.
    """
    gram, b, square, n = columns.T @ columns, columns.T @ y, y @ y, len(y)
    ln_s, ln_sigma = np.linspace(np.log(0.002), np.log(0.5), 80), np.linspace(-4.0, -1.5, 160)
    s, sigma = (g.ravel() for g in np.meshgrid(np.exp(ln_s), np.exp(ln_sigma)))
    variance = np.where(sizes == 0.0, s[:, None], sizes) ** 2  # (grid, p)
    A = gram / sigma[:, None, None] ** 2 + np.eye(len(sizes)) / variance[:, :, None]
    left = (
        square / sigma**2
        - np.linalg.solve(A, np.broadcast_to(b, A.shape[:2])[..., None])[..., 0] @ b / sigma**4
    )
    log_density = -0.5 * (
        n * np.log(2 * np.pi * sigma**2)
        + np.log(variance).sum(axis=1)
        + np.linalg.slogdet(A)[1]
        + left
    )
    prior = (
        half_normal(s, 0.05) + half_cauchy(sigma, 0.1) + np.log(s * sigma)
    )  # ds dσ = s·σ d(ln s) d(ln σ)
    cell = (ln_s[1] - ln_s[0]) * (ln_sigma[1] - ln_sigma[0])
    return logsumexp(log_density + prior) + np.log(cell)


WITHOUT = np.array([50.0, 0.05, 0.0, 0.0, 0.0])  # °/s, °/s/°C, and s of each run
plausible = 5e-4  # °/s/°C², how large the quadratic of such a gyroscope is
better = bc.fit(model + "bias.temperature_quadratic", readings)
before, after = log_evidence(line, WITHOUT), log_evidence(bent, np.append(WITHOUT, plausible))
print(f"log evidence without it {before:.2f} by hand, {fit.log_evidence[0]:.2f} by bc.fit")
print(f"log evidence with it    {after:.2f} by hand, {better.log_evidence[0]:.2f} by bc.fit")

# The evidence of the larger model is e⁹¹ times that of the line. The prior width stands in it: a
# candidate that may be anything between ± 1 °/s/°C² has given nearly all of its probability to
# what did not happen. So that nothing hangs on one guess, a search takes the size as known to an
# order of magnitude, and averages over 1, 3 and 10 times it.

factors, weights = (1.0, 3.0, 10.0), (0.6, 0.3, 0.1)
gains = [log_evidence(bent, np.append(WITHOUT, k * plausible)) - before for k in factors]
by_hand = logsumexp(gains, b=weights)
print("log Bayes factor at 1, 3 and 10 times the plausible size:", *np.round(gains, 2))
print(f"averaged over these: {by_hand:.2f}")

# %% 7. bc.discover says the same

# The search weighs every candidate of the instrument, and sets of them, under several noise laws;
# none is more probable beforehand because it is the one that we had in mind.

found = bc.discover(fit)
print(found)
first = found.candidates[0]
print(f"{first.effect}: log Bayes factor {first.log_bayes_factor:.2f}, by hand {by_hand:.2f}")

# *Confounded* are models that these readings hardly tell from the right one: a free curve over
# temperature says the same without a name. `found.best` is the effect to add, and with it nothing
# is left that depends on temperature.

better = bc.fit(model + found.best, readings)
print(bc.check(better))
print("held as hidden:", better.samples("bias.temperature_quadratic").mean().round(6), "°/s/°C²")

# %% 8. To firmware

# What corrects a reading is the model solved for the rate: subtract the bias at this temperature.
# The offset of a new run is not known; it is in the uncertainty, as wide as runs were found to
# differ.

correct = bc.compensator(better)
folder = Path(tempfile.mkdtemp())
correct.export(folder / "gyro.h")
(folder / "main.c").write_text(
    """
#include <stdio.h>
#include "gyro.h"

int main(void)
{
    mems_gyro_input in;
    while (scanf("%lf %lf", &in.reading, &in.temperature) == 2) {
        mems_gyro_result out = mems_gyro_compensate(&in);
        printf("%.17g %.17g\\n", out.value, out.uncertainty);
    }
    return 0;
}
""",
    "utf-8",
)
subprocess.run(["cc", "-std=c99", "-O2", "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
new = [
    (21.60, 35.0),
    (21.48, 55.0),
    (22.93, 78.0),
]  # °/s and °C, of a run that is not among those above
given = "\n".join(f"{rate} {temperature}" for rate, temperature in new)
ran = subprocess.run([folder / "main"], input=given, capture_output=True, text=True, check=True)

# Beside it the same by Python, and by the polynomial itself.

c0, c1, c2 = (
    better.samples(f"bias.{n}").mean() for n in ("constant", "temperature", "temperature_quadratic")
)
for (rate, temperature), line in zip(new, ran.stdout.splitlines(), strict=True):
    value, uncertainty = map(float, line.split())
    python = correct(output=rate, temperature=temperature, noise=False)
    plain = rate - (c0 + c1 * (temperature - T0) + c2 * (temperature - T0) ** 2)
    print(f"{rate} °/s at {temperature} °C: C {value:+.4f} ± {uncertainty:.4f} °/s, ", end="")
    print(f"Python {python.value[0]:+.4f} ± {python.uncertainty[0]:.4f}, by hand {plain:+.4f}")
