"""Settings, numbers that decide outcomes: which hold for what runs here, and which of them are not the usual ones."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import fields
from functools import cache
from types import MappingProxyType
from typing import TypeVar

S = TypeVar("S", bound="OutcomeSettings")


class OutcomeSettings:
    """Numbers that decide outcomes: a frozen dataclass of these says of each its unit, its reason, and where from.

    What only bounds work (points of a grid, draws, starts) is no setting and stands where it is used.
    """


_IN_FORCE: ContextVar[Mapping[type[OutcomeSettings], OutcomeSettings]] = ContextVar(
    "settings", default=MappingProxyType({})
)


@cache
def _usual(kind: type[S]) -> S:
    return kind()


def in_force(kind: type[S]) -> S:
    """The settings of a kind that hold here: those of `use_settings`, else the usual ones."""
    return _IN_FORCE.get().get(kind) or _usual(kind)  # pyright: ignore[reportReturnType]


@contextmanager
def use_settings(*settings: OutcomeSettings) -> Iterator[None]:
    """Let other settings hold for what runs inside, in this thread.

    Args:
        settings: of searches, guards, records or sampling, one of a kind.

    Raises:
        TypeError: something else was given.
    """
    for one in settings:
        if not isinstance(one, OutcomeSettings):
            raise TypeError(f"settings are SearchSettings, GuardSettings and the like, not {one!r}")
    token = _IN_FORCE.set({**_IN_FORCE.get(), **{type(one): one for one in settings}})
    try:
        yield
    finally:
        _IN_FORCE.reset(token)


def given_settings() -> tuple[OutcomeSettings, ...]:
    """What `use_settings` was given here, for it to be given again elsewhere: in threads, in workers."""
    return tuple(_IN_FORCE.get().values())


def unusual() -> dict[str, float | list[float]]:
    """OutcomeSettings that differ from the usual ones, by name."""
    found = {}
    for kind, one in _IN_FORCE.get().items():
        for field in fields(one):  # pyright: ignore[reportArgumentType]  every kind is a dataclass
            value = getattr(one, field.name)
            if value != getattr(_usual(kind), field.name):
                found[field.name] = list(value) if isinstance(value, tuple) else value
    return found
