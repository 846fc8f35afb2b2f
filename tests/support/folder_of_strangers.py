"""A folder as a stranger left it: modules that Python and libraries would import, settings that they would obey."""

from __future__ import annotations

from pathlib import Path

RAN = "ran.txt"
MODULES = (
    *("bayescal", "bayescal_models", "conftest", "contextlib", "json", "logging", "matplotlib"),
    *("multiprocessing", "numpy", "os", "pathlib", "random", "sitecustomize", "usercustomize"),
)
# Each fails aloud, or changes what is drawn, where it is read.
SETTINGS = {
    "matplotlibrc": b"text.usetex: True\nno.such.setting: \xff\n",
    "arvizrc": b"stats.ci_prob: 7\n",
    ".numba_config.yaml": b"disable_jit: 1\n",
    ".env": b"MPLBACKEND=pdf\nJAX_PLATFORMS=none\nPYTHONSTARTUP=json.py\n",
    "setup.cfg": b"[options]\nzip_safe = no_such_value\n",
    "pyproject.toml": b"[tool\n",
}


def strangers_folder(place: Path) -> Path:
    """The folder, made in `place`; whichever of its modules is run says so in `ran(folder)`."""
    folder = place / "strangers"
    folder.mkdir()
    for name in MODULES:
        code = f"with open({str(place / RAN)!r}, 'a') as said:\n    said.write({name + ' '!r})\n"
        (folder / f"{name}.py").write_text(code, "utf-8")
    for name, content in SETTINGS.items():
        (folder / name).write_bytes(content)
    offers = folder / "stranger-1.0.dist-info"
    offers.mkdir()
    (offers / "METADATA").write_text("Name: stranger\nVersion: 1.0\n", "utf-8")
    groups = ("bayescal.instruments", "bayescal.pair_selections")
    points = "".join(f"[{group}]\nmems_gyro = json:INSTRUMENT\n" for group in groups)
    (offers / "entry_points.txt").write_text(points, "utf-8")
    return folder


def ran(folder: Path) -> str:
    """Names of the modules that were run."""
    said = folder.parent / RAN
    return said.read_text("utf-8") if said.exists() else ""
