"""Entry point of the validation annex: its command, which imports heavy modules when it runs."""

from __future__ import annotations

from pathlib import Path

import bayescal as bc
from bayescal import workshop as ws


class ValidateCommand(ws.AsJson, ws.Command):
    """Compare this installation with certified values of standards.

    Exit status: 0 if every value is within its tolerance; 1 if one is not.
    """

    example = "bayescal validate --out validation.pdf --out validation.html"
    out: list[Path] | None = ws.opt("PDF or HTML file to write (repeatable).", None, "--out", "-o")
    standard: list[str] | None = ws.opt('Standard, such as "JCGM 100" (repeatable); else all.')

    def answer(self) -> ws.Answer:
        from bayescal._annexes.validation.document import WRITERS
        from bayescal._annexes.validation.validation_record import validate

        paths = self.out or []
        for path in paths:
            if path.suffix.lower() not in WRITERS:
                raise bc.InputError(f"--out {path}: name it ….pdf or ….html")
        record = validate(self.standard or ())
        for path in paths:
            WRITERS[path.suffix.lower()](record, path)
        why = f"{len(record.failed)} of {len(record.rows)} values are out of tolerance"
        return ws.Answer(record, why=why * bool(record.failed), written=", ".join(map(str, paths)))


ANNEX = {"commands": (ValidateCommand,)}
