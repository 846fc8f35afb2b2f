"""Each device's structure searched by itself, then fitted together with the devices that share it.

The search is that of `calibrate`: the same structures, the same walk, the same posterior; what a fleet does without
are the checks and pictures of every step. Coefficients come from the fit of a batch, in one program a structure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from bayescal._core.errors import BayescalError
from bayescal._data.measurements import Measurements
from bayescal._fleet.batch_result import BatchResult
from bayescal._fleet.devices import Devices
from bayescal._fleet.fit_devices import FitOptions, fit_together
from bayescal._fleet.fleet_settings import fleet_settings
from bayescal._model.effect import Effect
from bayescal._model.frame import Reference, reference_of
from bayescal._model.model import Model
from bayescal._search.discover import structures_over
from bayescal._search.library import Library
from bayescal._search.posterior import Posterior
from bayescal._search.walk import walk

KEPT = 50  # structures of a device


@dataclass(frozen=True)
class Find:
    """What is looked for in each device.

    Attributes:
        effects: candidates of the user's own, beside the instrument's.
        max_effects: most effects to add to a device.
        widen_noise: whether other noise laws are weighed.
    """

    effects: tuple[Effect, ...] = ()
    max_effects: int = 3
    widen_noise: bool = True


@dataclass(frozen=True)
class DeviceStructure:
    """What is missing from one device's model, as plain JSON holds it.

    Attributes:
        effects: of the structure to use.
        noise: its law; "" for that of the model given.
        nothing: probability that the model is complete.
        inclusion: effect → probability that it is, where that is not small.
        sets: of which one is missing each, with probability 0.95.
        prior: effect → probability before the readings, for all that they could show.
        weighed: sets of effects with their log evidence, all noise laws together, against the best.
    """

    effects: list[str]
    noise: str
    nothing: float
    inclusion: dict[str, float]
    sets: list[list[str]]
    prior: dict[str, float]
    weighed: list[tuple[list[str], float]]


def search_device(
    model: Model, readings: Measurements, find: Find, reference: Reference
) -> tuple[DeviceStructure, Model]:
    """The posterior over structures of one device, and the model of the one to use.

    Raises:
        BayescalError: the readings lack what the model needs.
    """
    model.require(readings)
    constants = {**reference_of(readings), **reference}
    structures, _ = structures_over(
        model, readings, constants, effects=find.effects, widen_noise=find.widen_noise
    )
    walk(Library(structures), find.max_effects)
    posterior = Posterior.of(structures)
    chosen = posterior.chosen
    inclusion = {n: posterior.inclusion(n) for n in structures.candidates}
    structure = DeviceStructure(
        sorted(chosen.effects),
        chosen.noise,
        posterior.nothing(),
        {n: p for n, p in inclusion.items() if p > fleet_settings().kept},
        [list(finding.effects) for finding in posterior.findings],
        {n: float(expit(odds)) for n, odds in structures.log_odds.items()},
        _weighed(posterior, structures.log_odds),
    )
    return structure, structures.weigh(chosen).model


def _weighed(posterior: Posterior, log_odds: Mapping[str, float]) -> list[tuple[list[str], float]]:
    """Sets of effects with their log evidence, the best first."""
    total: dict[tuple[str, ...], float] = {}
    for structure, log_posterior in zip(posterior.structures, posterior.total, strict=True):
        effects = tuple(sorted(structure.effects))
        own = log_posterior - sum(log_odds[name] for name in effects)
        total[effects] = float(np.logaddexp(total.get(effects, -np.inf), own))
    best = max(total.values())
    order = sorted(total, key=lambda effects: -total[effects])[:KEPT]
    return [
        (list(e), round(total[e] - best, 6))
        for e in order
        if total[e] > best - fleet_settings().behind
    ]


def find_and_fit(
    model: Model,
    devices: Devices,
    find: Find,
    options: FitOptions,
) -> tuple[BatchResult, dict[str, DeviceStructure]]:
    """Search each device, then fit those of one structure together: the results, and each device's structure.

    A device that cannot be searched is refused with the reason.
    """
    refused = dict(devices.refused)
    structures: dict[str, DeviceStructure] = {}
    alike: dict[tuple, tuple[Model, list[str]]] = {}
    for block in devices.blocks:
        for i, name in enumerate(block.names):
            try:
                structure, made = search_device(
                    model, block.measurements(i), find, options.reference
                )
            except BayescalError as error:
                refused[name] = str(error)
                continue
            structures[name] = structure
            # Departures and open sizes are a device's own: only equal models share a program.
            kind = (*structure.effects, structure.noise, repr(made.effects), repr(made.noise))
            alike.setdefault(kind, (made, []))[1].append(name)
    groups = [
        (made, devices.without({*devices.names} - {*names})) for made, names in alike.values()
    ]
    groups.insert(0, (model, Devices((), ())))  # after which the result is named
    return fit_together(devices.names, refused, groups, options), structures
