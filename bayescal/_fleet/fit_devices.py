"""Many devices of one type, fitted each by itself in this process."""

from __future__ import annotations

import numpy as np

from bayescal._core.errors import BayescalError, InputError, ModelError
from bayescal._core.jax_setup import spare_memory_maps
from bayescal._data.measurements import Measurements
from bayescal._fleet import fit_stack
from bayescal._fleet.batch_result import BatchResult
from bayescal._fleet.device_result import BatchPart
from bayescal._fleet.devices import DeviceBlock, Devices
from bayescal._fleet.fit_stack import StackFit
from bayescal._fleet.partial_pooling import pooled
from bayescal._fleet.population import Named
from bayescal._fleet.stacks import DeviceStack, Refusal, stacks
from bayescal._inference.least_squares import LeastSquares
from bayescal._inference.linear_model import sized
from bayescal._inference.marginal import Marginal
from bayescal._inference.method import Method
from bayescal._model.frame import Reference, build_frame, reference_name, reference_of
from bayescal._model.model import Model
from bayescal._model.parameters import Layout

CHUNK = 4096  # devices in one compiled program at most


def fit_devices(
    model: Model,
    devices: Devices,
    method: LeastSquares | Marginal,
    *,
    named: Named | None = None,
    seed: int = 0,
    chunk: int = CHUNK,
    reference: Reference | None = None,
    each: bool = False,
) -> BatchResult:
    """Fit every device by itself in a few compiled programs: see `fit_batch`.

    Args:
        model: what is fitted.
        devices: whose readings.
        method: of every fit.
        named: coefficients of a population, if any.
        seed: of every random number.
        chunk: devices fitted at once at most.
        reference: constants of the bases, in place of each device's own.
        each: whether a reason that all devices share refuses each of them, and not the whole.

    Raises:
        InputError: no device at all, or, unless `each`, none that can be used.
    """
    spare_memory_maps()
    if chunk < 1:
        raise InputError(f"chunk is {chunk}: give at least 1")
    if not len(devices) and not each:
        raise InputError("there is no device to fit: give at least one")
    reference = dict(reference or {})
    if named:
        reference = {**common_reference(devices), **reference}
    run = _BatchRun(model, method, seed=seed, chunk=chunk, reference=reference)
    run.fit(devices, each)
    return run.result(devices.names, named or {}, each)


def mappable(model: Model, method: Method) -> LeastSquares | Marginal:
    """The method, if it can be mapped over devices.

    Raises:
        ModelError: it cannot.
    """
    if not isinstance(method, LeastSquares | Marginal):
        raise ModelError(
            f"fit_batch maps LeastSquares() and Marginal() over devices, not {type(method).__name__}: fit them one by "
            "one with it"
        )
    if isinstance(method, Marginal) and (
        not model.noise.gaussian or method.sampler != "importance"
    ):
        raise ModelError(
            "fit_batch maps Marginal() over devices by importance sampling, which needs Gaussian noise: use "
            "LeastSquares(), or fit them one by one"
        )
    return method


def common_reference(devices: Devices) -> dict[str, float | dict[str, float]]:
    """T0 and its like over all devices, so that offsets mean the same for each."""
    sums: dict[str, list[np.ndarray]] = {}
    for block in devices.blocks:
        for name, unit in block.units.items():
            if unit == "degC" and name != "temperature_point":
                sums.setdefault(name, []).append(block.values[name])
    return {
        reference_name(name): float(np.round(np.mean(np.concatenate(values))))
        for name, values in sums.items()
    }


def sized_for(model: Model, readings: Measurements, reference: Reference) -> Model:
    """Plausible amplitudes of what no named effect describes, where they are open: one device's, for all."""
    if not any(e.open for e in model.effects):
        return model
    frame = build_frame(readings, {**reference_of(readings), **reference})
    return sized(model, readings, frame)


class _BatchRun:
    """Fits as they come in."""

    def __init__(
        self,
        model: Model,
        method: LeastSquares | Marginal,
        *,
        seed: int,
        chunk: int,
        reference: Reference,
    ) -> None:
        self.model, self.method, self.seed, self.chunk = model, method, seed, chunk
        self.reference = reference
        self.refused: dict[str, str] = {}
        self.notes: dict[str, None] = {}
        self.reasons: dict[str, str] = {}
        self.ways: dict[str, bool] = {}
        self.found: dict[tuple[tuple[str, str], ...], list[tuple]] = {}

    def fit(self, devices: Devices, each: bool) -> None:
        """Fit every device that can be fitted.

        Raises:
            BayescalError: no block can be used, and not `each`; what is said of the first.
        """
        self.refused |= devices.refused
        wrong: list[BayescalError] = []
        for block in devices.blocks:
            try:
                self.model.require(block.measurements(0))
                self.model = sized_for(self.model, block.measurements(0), self.reference)
                self._add(block)
            except BayescalError as error:  # a column is missing, of all its devices
                wrong.append(error)
                self.refused = dict.fromkeys(block.names, str(error)) | self.refused
        if wrong and len(wrong) == len(devices.blocks) and not each:
            raise wrong[0]

    def _add(self, block: DeviceBlock) -> None:
        masked = self._masked(block)
        for stack in stacks(self.model, block, self.reference, masked, self.chunk):
            if isinstance(stack, Refusal):
                self.refused[block.names[stack.device]] = stack.reason
                continue
            layout, way = Layout(self.model, stack.counts), self._straight(stack)
            self._keep(block, stack, fit_stack.solve(layout, stack, self.method, self.seed, way))

    def _masked(self, block: DeviceBlock) -> bool:
        """Whether padded readings cost nothing: on the quick way, which leaves them out."""
        for stack in stacks(self.model, block, self.reference, False, 1):
            if isinstance(stack, DeviceStack):
                return self._straight(stack)
        return False

    def _straight(self, stack: DeviceStack) -> bool:
        """Whether the quick way is open, asked once for groups of these sizes and columns of these names."""
        kind = (dict(stack.counts) | {"reading": 0}, sorted(stack.frame.columns))
        if str(kind) not in self.ways:
            layout = Layout(self.model, stack.counts)
            self.ways[str(kind)] = fit_stack.straight(layout, stack, self.method)
        return self.ways[str(kind)]

    def _keep(self, block: DeviceBlock, stack: DeviceStack, made: StackFit) -> None:
        self.notes |= dict.fromkeys(made.notes)
        alike: dict[tuple, list[int]] = {}
        if _grouped(made.layout):  # then unknowns are called after the members, each device's own
            for i, levels in enumerate(stack.levels):
                alike.setdefault(tuple(levels.items()), []).append(i)
        for members in alike.values() or [list(range(len(stack.devices)))]:
            own = tuple(fit_stack.unknowns(made.layout, stack.levels[members[0]]))
            names = [block.names[stack.devices[i]] for i in members]
            self.found.setdefault(own, []).append(
                (names, made.mean[members], made.covariance[members])
            )
            self.reasons |= dict(zip(names, (made.reasons[i] for i in members), strict=True))

    def result(self, devices: tuple[str, ...], named: Named, each: bool) -> BatchResult:
        """Everything that was found, in the order of the devices; pooled over those of `named`, if any."""
        refused = self.refused
        places = {name: i for i, name in enumerate(devices)}
        parts = []
        for own, pieces in self.found.items():
            at = np.array([places[n] for names, _, _ in pieces for n in names], dtype=int)
            order = np.argsort(at)
            mean = np.concatenate([m for _, m, _ in pieces])[order]
            covariance = np.concatenate([c for _, _, c in pieces])[order]
            names, units = zip(*own, strict=True) if own else ((), ())
            parts.append(
                BatchPart(
                    devices=at[order], names=names, units=units, mean=mean, covariance=covariance
                )
            )
        if not parts and refused and not each:
            first = next(iter(refused.items()))
            raise InputError(
                f"none of the {len(devices)} devices can be used; {first[0]}: {first[1]}"
            )
        reasons = [refused.get(name) or self.reasons.get(name, "") for name in devices]
        ok = np.array([not reason for reason in reasons], dtype=bool)
        population = None
        if named:
            parts, population = pooled(parts, ok, named, self.seed)
        about = {
            "instrument": self.model.instrument.name,
            "effects": list(self.model.names),
            "noise": self.model.noise.law,
            "method": self.method.name,
            "seed": self.seed,
            "reference": {k: v for k, v in self.reference.items() if not isinstance(v, dict)},
            "notes": list(self.notes),
        }
        return BatchResult(
            devices=devices,
            ok=ok,
            reasons=tuple(reasons),
            parts=tuple(parts),
            population=population,
            about=about,
        )


def _grouped(layout: Layout) -> bool:
    return any(b.coefficient.per not in (None, "reading") for b in layout.blocks)
