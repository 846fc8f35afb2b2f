"""What the annex of validation offers: the command. Heavy modules load inside it."""

from __future__ import annotations

from pathlib import Path

import bayescal as bc
from bayescal import workshop as ws


class ValidateCommand(ws.AsJson, ws.Command):
    """Compare this installation with certified values of standards.

    Exit status: 0 where every value is within its tolerance; 1 where one is not.
    """

    example = "bayescal validate --out validation.html"
    out: Path | None = ws.opt("HTML file to write; a browser prints it.", None, "--out", "-o")
    standard: list[str] | None = ws.opt('Such as "JCGM 100", else all; repeat for more.')

    def answer(self) -> ws.Answer:
        from bayescal._annexes.validation.validation_record import validate

        if self.out is not None and self.out.suffix.lower() != ".html":
            raise bc.InputError(f"--out {self.out}: name it ….html")
        record = validate(self.standard or ())
        if self.out is not None:
            ws.write_text(record.html(), self.out)
        why = f"{len(record.failed)} of {len(record.rows)} values are not as certified"
        return ws.Answer(record, ok=not record.failed, why=why, written=str(self.out or ""))


ANNEX = {"commands": (ValidateCommand,)}
