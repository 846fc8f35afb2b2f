"""Prior standard deviations of a structure's coefficients, given its learned spreads and amplitudes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from bayescal._engine.pieces import Term
from bayescal._model.effect import Effect


class Sizes:
    """Prior standard deviations of x as a function of φ's values; one where the prior is flat."""

    def __init__(self, terms: Sequence[Term], effects: Sequence[Effect], size: int):
        self.plain = np.ones(size)
        self.flat = np.zeros(size, dtype=bool)
        for t in terms:
            self.flat[t.at] = t.known.flat
            if not t.known.flat and t.spread_name is None:
                self.plain[t.at] = t.prior_sd
        self.learned = [(t.at, t.spread_name) for t in terms if t.spread_name is not None]
        self.weighted: list[tuple[Any, list[tuple[str, str]], list[slice | None]]] = []
        for effect in effects:
            if effect.weights is not None:
                names = [(name, f"{effect.name}.{name}") for name in effect.weight_shapes]
                own = {t.index: t.at for t in terms if t.known.of == effect.name}
                places = [own.get(i) for i in range(len(effect.coefficients))]
                self.weighted.append((effect.weights, names, places))

    def at(self, hyper: dict[str, float]) -> Float[np.ndarray, "p"]:
        """At one φ, its values by name."""
        sd = self.plain.copy()
        for place, name in self.learned:
            sd[place] = hyper[name]
        for weights, names, places in self.weighted:
            made = weights(**{short: hyper[name] for short, name in names})
            for at, one in zip(places, np.broadcast_to(made, (len(places),)), strict=True):
                if at is not None:
                    sd[at] *= one
        return sd

    def at_several(
        self, hyper: dict[str, Any], count: int, flat: Float[np.ndarray, "p"]
    ) -> Float[np.ndarray, "b p"]:
        """At several φ, the values of each (b,); `flat` where the prior is flat."""
        sd = np.tile(np.where(self.flat, flat, self.plain), (count, 1))
        for place, name in self.learned:
            sd[:, place] = np.reshape(hyper[name], (-1, 1))
        for weights, names, places in self.weighted:
            columns = {short: np.reshape(hyper[name], (-1, 1)) for short, name in names}
            made = np.broadcast_to(weights(**columns), (count, len(places)))
            for at, one in zip(places, made.T, strict=True):
                if at is not None:
                    sd[:, at] *= one[:, None]
        return sd
