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
    """Run a command; return its exit status, 2 for an error in the arguments or input files."""
    args = _parser().parse_args(arguments)
    try:
        return args.command(args)
    except InputError as error:
        print(f"missing_effect: {error}", file=sys.stderr)
        return 2


def _generate(args: argparse.Namespace) -> int:
    try:
        from missing_effect_maker import generate, real
    except ImportError:
        raise InputError(
            "the package that makes tasks is not installed: run "
            "`pip install ./benchmarks/missing_effect/maker` in a checkout of the repository"
        ) from None
    sizes = generate.sizes(args.edition)
    if args.size not in (0, *sizes):
        raise InputError(
            f"edition {args.edition} has the sizes {', '.join(map(str, sizes))}, not {args.size}"
        )
    hashes = dict(generate.generate(args.tasks, args.size, args.edition))
    print(f"{len(hashes)} tasks of edition {args.edition} in {args.tasks}")
    if hashes and args.edition == EDITION:
        published_editions = published()
        other = [name for name, digest in hashes.items() if published_editions.get(name) != digest]
        if other:
            print(f"different from the published edition: {', '.join(other)}", file=sys.stderr)
            return 1
        print("all tasks are byte for byte those of the published edition")
    if args.data is None:
        print("without the real track: give the folder of its records by --data (DATASHEET.md)")
        return 0
    if not args.data.is_dir():
        raise InputError(f"--data {args.data} is not a folder")
    for line in real.generate(args.data, args.tasks):
        print(line)
    return 0


def _run(args: argparse.Namespace) -> int:
    failed = 0
    for entry in map(entry_file, args.entries):
        for name, answer in run(
            entry, args.tasks, args.results, args.size, args.limit, args.trusted
        ):
            failed += "failed" in answer
            outcome = answer.get("failed") or "answered"
            print(f"{entry.stem} {name} {answer['seconds']:.1f} s {outcome}", flush=True)
    return 1 if failed else 0


def _score(args: argparse.Namespace) -> int:
    scores = {name: scored(args.tasks, args.results, name, args.size) for name in args.entries}
    if args.json:
        print(
            json.dumps({e: {t: vars(s) for t, s in f.items()} for e, f in scores.items()}, indent=1)
        )
    else:
        print(leaderboard.markdown(scores))
    return 0


def _leaderboard(args: argparse.Namespace) -> int:
    names = entries_in(args.results, args.tasks, args.size)
    if not names:
        raise InputError(f"{args.results}: no entry has answered all tasks: run an entry first")
    scores = {n: scored(args.tasks, args.results, n, args.size) for n in (*names, ORACLE)}
    strange = alien(args.tasks, args.size)
    note = f"{len(next(iter(scores.values())))} tasks"
    note += (
        f", of which {len(strange)} are not of the published edition."
        if strange
        else " of the published edition."
    )
    leaderboard.write(scores, args.out, note)
    print(leaderboard.markdown(scores))
    print(f"{note} Page: {args.out}")
    return 0


def _describe(args: argparse.Namespace) -> int:
    if not (args.task / "task.json").is_file():
        raise InputError(f"{args.task} is not the folder of a task: it has no task.json")
    task = Task.read(args.task)
    args.out.write_text(picture(task), "utf-8")
    print(in_words(task))
    print(f"Plots: {args.out}")
    return 0


def _parser() -> argparse.ArgumentParser:
    sub_parser = argparse.ArgumentParser(prog="python -m missing_effect", description=__doc__)
    commands = sub_parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, does, text: str) -> argparse.ArgumentParser:
        sub_parser = commands.add_parser(name, help=text, description=text)
        sub_parser.set_defaults(command=does)
        return sub_parser

    def where(sub_parser: argparse.ArgumentParser, results: bool = True) -> None:
        sub_parser.add_argument(
            "--tasks", type=Path, default=Path("tasks"), help="folder of the tasks"
        )
        if results:
            sub_parser.add_argument(
                "--results", type=Path, default=Path("results"), help="folder of the answers"
            )
            sub_parser.add_argument(
                "--size", type=int, help="number of tasks, from the first; default: all"
            )

    sub = command("generate", _generate, "generate the tasks")
    sub.add_argument("tasks", type=Path, nargs="?", default=Path("tasks"))
    sub.add_argument("--size", type=int, default=10, help="number of tasks: 10, 100, 200 or 600")
    sub.add_argument("--edition", type=int, default=EDITION, help="number of the edition")
    sub.add_argument(
        "--data", type=Path, help="folder of public records, for the real tasks (DATASHEET.md)"
    )
    sub = command("run", _run, "solve the tasks by entries")
    sub.add_argument(
        "entries", nargs="+", help="Python files with solve(task), or names of shipped entries"
    )
    sub.add_argument("--limit", type=float, default=LIMIT, help="processor time per task, s")
    sub.add_argument(
        "--trusted", action="store_true", help="run in this process without isolation: faster"
    )
    where(sub)
    sub = command("score", _score, "score entries, as text or JSON")
    sub.add_argument("entries", nargs="+")
    sub.add_argument("--json", action="store_true")
    where(sub)
    sub = command("leaderboard", _leaderboard, "write a page of all entries with all answers")
    sub.add_argument("--out", type=Path, default=Path("leaderboard.html"))
    where(sub)
    sub = command("describe", _describe, "describe a task in words and plots")
    sub.add_argument("task", type=Path, help="folder of a task")
    sub.add_argument("--out", type=Path, default=Path("task.html"))
    return sub_parser


if __name__ == "__main__":
    raise SystemExit(main())
