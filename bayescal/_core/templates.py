"""Jinja templates of pages and code."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from bayescal._core.quoting import number_text


def template(package: str, name: str, filters: Mapping[str, Callable[..., Any]], **how: Any) -> Any:
    """Load a template from the folder `templates` of a package; an undefined variable in it is an error.

    Filters are `filters` and `digits`, which prints a number with all digits; `how`: options of `jinja2.Environment`.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined  # only where it is needed

    environment = Environment(
        loader=PackageLoader(package),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        **how,
    )
    environment.filters |= {"digits": number_text, **filters}
    return environment.get_template(name)
