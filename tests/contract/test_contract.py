"""The contract: every instrument × every check. A new instrument is a folder and one line in `INSTRUMENTS`.

What an instrument says of itself, and that its algebra is what it declares.
"""

from __future__ import annotations

import inspect
import itertools
import re
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import bayescal as bc
from bayescal_models import INSTRUMENTS
from tests.support.contract_cases import Case
from tests.support.inside import constants_of, forward, frame_of
from tests.support.made_up.supply import AT_SUPPLY
from tests.support.tiers import slow_but

# Differences of all candidates of an instrument take seconds to compile.
SMALL_FIRST = slow_but(("mems_gyro", "inclinometer", "still_sensor"), INSTRUMENTS)
CANONICAL = re.compile(r"[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*")


def test_instrument_is_registered_under_its_name(case: Case) -> None:
    assert case.offered.name == case.name
    assert case.offered.simulator is not None
    shown = inspect.signature(case.module.simulate).parameters
    assert list(shown) == list(inspect.signature(case.offered.simulator).parameters)
    assert case.model.instrument.name == case.name


def test_effects_have_canonical_names_equations_and_sources(case: Case) -> None:
    names = [e.name for e in case.own_effects]
    assert len(set(names)) == len(names)
    for effect in (*case.own_effects, *case.structural):
        slots = {case.instrument.slot(c.slot or effect.slot).name for c in effect.coefficients}
        # `slot.cause`, or the bare name of the slot for the one constant that it has.
        assert CANONICAL.fullmatch(effect.name) or effect.name in slots, effect.name
        assert effect.equation, f"{effect.name} has no equation"
        assert effect.source not in ("", "the user's own"), f"{effect.name} has no source"


def test_data_sheet_names_only_existing_effects(case: Case) -> None:
    sheet = sys.modules[f"bayescal_models.{case.name}.model"].__doc__
    assert sheet is not None
    files = (".py", ".json", ".csv", ".md")
    named = {
        n for n in re.findall(r"`([a-z]\w*\.\w+(?:\[[^\]]+\])?)`", sheet) if not n.endswith(files)
    }
    effects = (*case.own_effects, *case.structural, *case.model.effects)
    known = {e.name for e in effects} | {e.shape_name(s) for e in effects for s in e.shapes}
    known |= {e.coefficient_name(i) for e in effects for i in range(len(e.coefficients))}
    known |= {f"{c.name}.reading" for c in case.instrument.columns}  # errors of a thermometer
    assert named <= known, f"on the data sheet, not in the model: {sorted(named - known)}"


def test_readings_are_reproducible_by_seed(case: Case) -> None:
    laws = getattr(sys.modules.get(f"bayescal_models.{case.name}.simulator"), "NOISE_LAWS", ())
    for how in [{"noise_law": law} for law in laws] or [{}]:
        first, again, other = (case.module.simulate(seed=s, **how) for s in (7, 7, 8))
        assert first.columns == again.columns == other.columns and len(first) == len(other)
        for name in first.columns:
            np.testing.assert_array_equal(first[name], again[name])
        assert (first["output"] != other["output"]).mean() > 0.9


def test_unknown_hidden_effect_is_refused(case: Case) -> None:
    known = case.instrument.candidates[0].name
    with pytest.raises(ValueError):
        case.module.simulate({"no.such": 1.0}, seed=0)
    with pytest.raises(ValueError):
        case.module.simulate({known: float("nan")}, seed=0)


def test_the_reference_problem_is_small_fixed_and_proper(case: Case) -> None:
    other = case.problem.readings(seed=1)
    assert len(case.readings) == len(other) <= 200
    assert case.readings.columns == other.columns
    assert (case.readings["output"] != other["output"]).mean() > 0.9
    assert not case.bound.layout.is_improper


@pytest.mark.parametrize("case", SMALL_FIRST, indirect=True)
def test_the_jacobian_is_that_of_finite_differences(case: Case) -> None:
    line, sd, columns = case.differences
    noisy = [b for b in case.bound.layout.blocks if b.place == "input"]
    assert line.inputs.shape == (len(case.readings), len(noisy))
    assert all(np.isfinite(part).all() for part in line)
    own, rounding = line.jacobian * sd, 1e-9 * np.abs(line.mean).max()
    scale = np.abs(own).max(axis=0)
    apart = np.abs(own - columns)
    worst = np.argmax((apart - 1e-5 * scale).max(axis=0)) if own.size else 0
    assert (apart <= 1e-5 * scale + rounding).all(), f"column {worst}"


# What a coefficient of the first unit times its basis is in the slot's, where it is not one. By hand: the basis is in
# s, rad, °C/s and µg where the coefficient says min or h, deg, °C/min or °C/h and g.
FACTORS = {
    **{(f"m{unit}{per}", unit): 1e-3 for unit in ("g", "rad") for per in ("", "/degC", "/degC^2")},
    **{(f"ppm{per}", "1"): 1e-6 for per in ("", "/degC", "/degC^2", "/degC^3")},
    **{(f"urad{per}", "rad"): 1e-6 for per in ("", "/degC")},
    **{(f"{unit}/(degC/min)", unit): 60.0 for unit in ("1", "ug", "deg/s")},
    ("mg/g^2", "1/g"): 1e-3, ("mg/g^3", "1/g^2"): 1e-3, ("ms", "s"): 1e-3, ("nrad", "rad"): 1e-9,
    ("ppm*s/deg", "s/deg"): 1e-6, ("ppm/g", "1"): 1e-6 * 1e-6, ("ppm/g^2", "1"): 1e-6 * 1e-12,
    ("ppm/(degC/min)", "1"): 1e-6 * 60, ("ppm/degC/(degC/min)", "1"): 1e-6 * 60,
    ("ug/degC/(degC/min)", "ug"): 60.0, ("ug/(degC/h)", "ug"): 3600.0,
    ("arcsec", "rad"): np.pi / 180 / 3600, ("deg", "rad"): np.pi / 180,
    ("arcsec/deg", "arcsec"): 180 / np.pi, ("arcsec/deg^2", "arcsec"): (180 / np.pi) ** 2,
}  # fmt: skip


def contributions(
    case: Case, effect: bc.Effect, readings: bc.Measurements, at: tuple
) -> np.ndarray:
    """What each of its coefficients adds to the output, and then constants of its slots, to first order, on the host.

    Args:
        at: coordinates of its shapes.
    """
    frame = frame_of(readings, {**constants_of(readings), **AT_SUPPLY})
    shapes = {s.name: float(s.prior.value(v)) for s, v in zip(effect.shapes, at, strict=True)}
    bases, columns = np.asarray(effect.evaluate(frame, shapes)).T, list[np.ndarray]()
    slots = {s.name: np.zeros(frame.size) for s in case.instrument.slots}
    at_rest, slopes = case.instrument.response(slots, frame), {}
    for basis, c in zip(bases, effect.coefficients, strict=True):
        slot = c.slot or effect.slot
        moved = case.instrument.response({**slots, slot: slots[slot] + STEP}, frame)
        slopes[slot] = np.asarray(moved - at_rest) / STEP
        codes = np.zeros(frame.size, int) if c.per is None else np.asarray(frame.codes[c.per])
        columns += [basis * slopes[slot] * (codes == member) for member in range(codes.max() + 1)]
    levels = slopes.values() if np.ptp(bases, axis=1).any() else ()
    return np.stack([*columns, *levels], axis=1)


STEP = 1e-6  # of a slot
SETTINGS = (-1.5, -0.75, 0.0, 0.75, 1.5)  # of a shape, standard deviations of its prior
NEAR = 0.4  # of its root mean square, what a basis may leave of the effect that it stands for


@pytest.mark.parametrize("case", SMALL_FIRST, indirect=True)
def test_a_hidden_candidate_is_as_large_as_stated_and_near_its_basis(case: Case) -> None:
    plain = {}
    for effect in case.instrument.candidates:
        name, first = effect.name, effect.coefficients[0]
        nothing, shown, twice = (case.hide({name: k * first.size}, seed=3) for k in (0.0, 1.0, 2.0))
        for column in effect.columns:
            assert shown.has(column), f"{name} needs {column}, which its campaign lacks"
        change, double = (readings["output"] - nothing["output"] for readings in (shown, twice))
        largest = np.abs(change).max()
        assert np.isfinite(change).all() and largest > 0, name
        # The same seed, the same noise: without the effect the readings are the same.
        key = (nothing.columns, len(nothing))
        np.testing.assert_array_equal(plain.setdefault(key, nothing["output"]), nothing["output"])
        if case.instrument.vector is None:  # where the norm is fitted, it bends
            np.testing.assert_allclose(double, 2 * change, atol=0.02 * largest)
        found = []
        for at in itertools.product(SETTINGS, repeat=len(effect.shapes)):
            columns = contributions(case, effect, shown, at)
            scale = np.abs(columns).max(axis=0) + 1e-300
            size = np.linalg.lstsq(columns / scale, change)[0] / scale
            found.append((np.std(change - columns @ size), size[0]))
        left, size = min(found)
        if not columns.any():  # of a product of unknowns the first order is nothing
            continue
        assert left < NEAR * np.sqrt(np.mean(change**2)), (name, left)
        if not effect.shapes and [c.per for c in effect.coefficients] == [None]:
            factor = FACTORS.get((first.unit, case.instrument.slot(effect.slot).unit), 1.0)
            assert size == pytest.approx(factor * first.size, rel=0.25), name


@pytest.mark.parametrize("case", SMALL_FIRST, indirect=True)
def test_every_slot_is_linear_in_its_coefficients(case: Case) -> None:
    # The slots' sums, computed here with one basis after the other, double and add with the coefficients.
    b = case.bound
    effects = tuple(e for e in case.wide.effects if _feeds_slots(case, e))
    model = bc.Model(case.instrument, effects, case.wide.noise)
    layout = type(b.layout)(model, b.layout.counts)
    hyper = layout.hyper(jnp.zeros(len(layout.hypers)))
    x = forward.prior_sd(layout, hyper) * jnp.linspace(-1.0, 1.0, layout.size)

    @eqx.filter_jit
    def slots_and_bases(frame, x):
        bases = {
            e.name: e.evaluate(frame, {s.name: hyper[e.shape_name(s)] for s in e.shapes})
            for e in effects
        }
        slots = forward.compose_at(layout, frame, x, hyper)[2].slots
        none = dict.fromkeys((s.name for s in case.instrument.slots), jnp.zeros(frame.size))
        return none | slots, bases

    (once, bases), (twice, _) = (slots_and_bases(b.frame, share * x) for share in (1.0, 2.0))
    expected = {slot.name: np.zeros(b.frame.size) for slot in case.instrument.slots}
    for block in (k for k in layout.blocks if k.place == "x"):
        basis = np.asarray(bases[block.effect.name])[:, block.index]
        values = np.asarray(x[block.start : block.start + block.size])
        per = block.coefficient.per
        codes = np.zeros(b.frame.size, int) if per is None else np.asarray(b.frame.codes[per])
        share = np.where(codes >= 0, values[codes], 0.0)
        factor = FACTORS.get((block.coefficient.unit, case.instrument.slot(block.slot).unit), 1.0)
        expected[block.slot] += basis * share * factor
    for slot, value in expected.items():
        scale = np.abs(value).max() + 1e-300
        np.testing.assert_allclose(once[slot] / scale, value / scale, atol=1e-9)
        np.testing.assert_allclose(twice[slot] / scale, 2 * value / scale, atol=1e-9)


def _feeds_slots(case: Case, effect: bc.Effect) -> bool:
    slots = {s.name for s in case.instrument.slots}
    return all((c.slot or effect.slot) in slots for c in effect.coefficients)
