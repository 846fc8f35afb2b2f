#!/usr/bin/env -S uv run --script
# /// script
# dependencies = ["nox>=2025.11"]
# ///
"""The tests on every Python that this machine has: `nox`, or `nox -s test-3.14 -- -k startup`. All else: Makefile."""

import nox

nox.needs_version = ">=2025.11"
nox.options.default_venv_backend = "uv|virtualenv"
PROJECT = nox.project.load_toml("pyproject.toml")


@nox.session(python=nox.project.python_versions(PROJECT))
def test(session: nox.Session) -> None:
    """The fast tests."""
    session.install("-e", ".", *nox.project.dependency_groups(PROJECT, "test"))
    session.run("pytest", "-n", "2", "--dist", "loadfile", *session.posargs)


if __name__ == "__main__":
    nox.main()
