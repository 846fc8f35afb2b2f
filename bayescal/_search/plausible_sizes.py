"""Evidence averaged over plausible sizes: each is known to an order of magnitude, not to a factor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from bayescal._calibration.settings import searching
from bayescal._inference.assembly import Assembly
from bayescal._inference.density import NOWHERE, Density
from bayescal._inference.gaussian import condition
from bayescal._inference.mode import Mode, at_mode, find_mode
from bayescal._model.effect import Effect

STILL = 0.03  # standard deviations to which a mode is found: its log evidence to 1e-3


def factors() -> dict[float, float]:
    """Factors on a plausible size, and their probabilities."""
    return dict(searching().factors)


def has_size(effect: Effect) -> bool:
    """Whether its size is a prior's standard deviation, and not learned."""
    return not effect.is_placeholder and any(
        c.group_sd is None and not c.flat for c in effect.coefficients
    )


def averaged(
    assembly: Assembly, mode: Mode, sized: Sequence[Effect]
) -> tuple[Assembly, Mode, float]:
    """The structure at its likeliest sizes, and its log evidence averaged over all.

    One effect's size at a time, the others' at their likeliest.

    Args:
        assembly: the structure, its sizes those of a start.
        mode: where it has its mode, its Gaussian fit not made.
        sized: effects with a plausible size.
    """
    if not math.isfinite(mode.log_evidence):
        return assembly, mode, mode.log_evidence
    begun = {e.name: (assembly.size_factors or {}).get(e.name, 1.0) for e in sized}
    at_sizes, chosen = _AtSizes(assembly, mode, begun), dict(begun)
    # Coordinate ascent over sizes: an effect that overlaps another may take its size back in the second pass.
    for _ in range(2):
        before = dict(chosen)
        for name in chosen:
            gains = at_sizes.of(name, chosen)
            chosen[name] = max(gains, key=gains.__getitem__)
        if chosen == before:
            break
    if chosen != begun:
        assembly = Assembly(assembly.layout, assembly.record, dict(chosen))
        mode = find_mode(assembly, [mode.v], mode.covariance, mode.point, STILL)
    else:
        mode = at_mode(
            Density(assembly, mode.point, mode.flat, mode.v), mode.v, mode.change, quick=True
        )
    # Σ over the sizes of one effect, the others at their likeliest: as if ratios of evidence multiplied. They do
    # where effects do not overlap; where they do, one of them mostly has its size by the other's.
    at_sizes = _AtSizes(assembly, mode, chosen)
    log_evidence = mode.log_evidence
    for name in chosen:
        gains = at_sizes.of(name, chosen)
        here = gains[chosen[name]] - math.log(factors()[chosen[name]])
        log_evidence += float(np.logaddexp.reduce(list(gains.values()))) - here
    return assembly, mode, log_evidence


class _AtSizes:
    """Log density at a mode's φ for other sizes of its effects, times their probabilities."""

    def __init__(self, assembly: Assembly, mode: Mode, made_at: Mapping[str, float]):
        density, hyper = Density(assembly, mode.point, mode.flat), assembly.hyper(mode.v)
        self.gram, self.at = density.gram(mode.v, hyper), mode.point.x
        self.size = assembly.record.size
        self.prior, self.made_at = assembly.prior(hyper, mode.flat), dict(made_at)
        # Learned spreads are no plausible sizes: φ has them, and the evidence is averaged over them already.
        self.places = {
            name: [t.at for t in assembly.in_x if t.known.of == name and t.group_sd_name is None]
            for name in made_at
        }

    def of(self, name: str, chosen: Mapping[str, float]) -> dict[float, float]:
        """For each size of one effect, the others as chosen."""
        found = {}
        for factor, probability in factors().items():
            sd = self.prior.sd.copy()
            for other, places in self.places.items():
                share = (factor if other == name else chosen[other]) / self.made_at[other]
                for place in places:
                    sd[place] *= share
            # A size is a prior standard deviation: the products are as they are, and only the small solve is done
            # anew.
            got = condition(self.gram, self.size, self.prior._replace(sd=sd), self.at)
            value = NOWHERE if got is None else got.log_marginal
            found[factor] = value + math.log(probability)
        return found
