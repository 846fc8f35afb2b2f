"""The commands: `python -m missing_effect generate | run | score | leaderboard | describe`, each with `--help`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from missing_effect import leaderboard
from missing_effect.describe import in_words, picture
from missing_effect.edition import EDITION, published
from missing_effect.run import LIMIT, InputError, entry_file, run
from missing_effect.score import ORACLE, alien, entries_in, scored
from missing_effect.task import Task


def main(arguments: list[str] | None = None) -> int:
    """Run a command; 2 where what was asked for cannot be done."""
    asked = _parser().parse_args(arguments)
    try:
        return asked.command(asked)
    except InputError as error:
        print(f"missing_effect: {error}", file=sys.stderr)
        return 2


def _generate(asked: argparse.Namespace) -> int:
    try:
        from missing_effect_maker import generate, real
    except ImportError:
        raise InputError(
            "tasks are made by a package of its own, which is not installed: "
            "`pip install ./benchmarks/missing_effect/maker` in a checkout of the repository"
        ) from None
    sizes = generate.sizes(asked.edition)
    if asked.size not in (0, *sizes):
        raise InputError(
            f"edition {asked.edition} has sizes {', '.join(map(str, sizes))}, not {asked.size}"
        )
    hashes = dict(generate.generate(asked.tasks, asked.size, asked.edition))
    print(f"{len(hashes)} tasks of edition {asked.edition} in {asked.tasks}")
    if hashes and asked.edition == EDITION:
        known = published()
        other = [name for name, digest in hashes.items() if known.get(name) != digest]
        if other:
            print(f"not as published: {', '.join(other)}", file=sys.stderr)
            return 1
        print("every one byte for byte as published")
    if asked.data is None:
        print("the real track is left out: --data names a folder with its records (DATASHEET.md)")
        return 0
    if not asked.data.is_dir():
        raise InputError(f"--data {asked.data} is no folder")
    for line in real.generate(asked.data, asked.tasks):
        print(line)
    return 0


def _run(asked: argparse.Namespace) -> int:
    failed = 0
    for entry in map(entry_file, asked.entries):
        for name, answer in run(
            entry, asked.tasks, asked.results, asked.size, asked.limit, asked.trusted
        ):
            failed += "failed" in answer
            said = answer.get("failed") or "answered"
            print(f"{entry.stem} {name} {answer['seconds']:.1f} s {said}", flush=True)
    return 1 if failed else 0


def _score(asked: argparse.Namespace) -> int:
    found = {name: scored(asked.tasks, asked.results, name, asked.size) for name in asked.entries}
    if asked.json:
        print(
            json.dumps({e: {t: vars(s) for t, s in f.items()} for e, f in found.items()}, indent=1)
        )
    else:
        print(leaderboard.markdown(found))
    return 0


def _leaderboard(asked: argparse.Namespace) -> int:
    names = entries_in(asked.results, asked.tasks, asked.size)
    if not names:
        raise InputError(f"{asked.results} has no entry with all answers: run one first")
    found = {n: scored(asked.tasks, asked.results, n, asked.size) for n in (*names, ORACLE)}
    strange = alien(asked.tasks, asked.size)
    note = f"{len(next(iter(found.values())))} tasks"
    note += (
        f", of which {len(strange)} are not of the published edition."
        if strange
        else ", as published."
    )
    leaderboard.write(found, asked.out, note)
    print(leaderboard.markdown(found))
    print(f"{note} The page: {asked.out}")
    return 0


def _describe(asked: argparse.Namespace) -> int:
    if not (asked.task / "task.json").is_file():
        raise InputError(f"{asked.task} is no task: it has no task.json")
    task = Task.read(asked.task)
    asked.out.write_text(picture(task), "utf-8")
    print(in_words(task))
    print(f"The picture: {asked.out}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m missing_effect", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, does, text: str) -> argparse.ArgumentParser:
        own = commands.add_parser(name, help=text, description=text)
        own.set_defaults(command=does)
        return own

    def where(own: argparse.ArgumentParser, results: bool = True) -> None:
        own.add_argument("--tasks", type=Path, default=Path("tasks"), help="folder of the tasks")
        if results:
            own.add_argument("--results", type=Path, default=Path("results"), help="of answers")
            own.add_argument("--size", type=int, help="the first so many tasks; all if not given")

    own = command("generate", _generate, "make the tasks")
    own.add_argument("tasks", type=Path, nargs="?", default=Path("tasks"))
    own.add_argument("--size", type=int, default=10, help="10, 100, 200 or 600")
    own.add_argument("--edition", type=int, default=EDITION, help="another number: new tasks")
    own.add_argument(
        "--data", type=Path, help="folder with public records: the real tasks too (DATASHEET.md)"
    )
    own = command("run", _run, "let entries solve tasks")
    own.add_argument(
        "entries", nargs="+", help="a Python file with solve(task), or a shipped entry's name"
    )
    own.add_argument("--limit", type=float, default=LIMIT, help="seconds of processor a task")
    own.add_argument(
        "--trusted", action="store_true", help="in this process, without isolation: quick"
    )
    where(own)
    own = command("score", _score, "score entries, as text or JSON")
    own.add_argument("entries", nargs="+")
    own.add_argument("--json", action="store_true")
    where(own)
    own = command("leaderboard", _leaderboard, "all entries with all answers, as a page")
    own.add_argument("--out", type=Path, default=Path("leaderboard.html"))
    where(own)
    own = command("describe", _describe, "a task in words, and a picture of it")
    own.add_argument("task", type=Path, help="folder of a task")
    own.add_argument("--out", type=Path, default=Path("task.html"))
    return parser


if __name__ == "__main__":
    raise SystemExit(main())
