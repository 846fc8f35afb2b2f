"""`bayescal validate`: examples of standards and NIST's sets pass here, and a value that is not met fails."""

from __future__ import annotations

from copy import deepcopy

import pytest

from tests.support.command_line import needs_installation, run
from tests.support.inside import validation_record

pytestmark = needs_installation
CONFORMITY = ("validate", "--standard", "JCGM 106")
JCGM_106 = "JCGM 106", "7.4"


def test_documents_hold_each_clause_and_its_outcome(tmp_path) -> None:
    pdf, html = (tmp_path / f"validation.{kind}" for kind in ("pdf", "html"))
    more = ("--standard", "JCGM 100", "--standard", "ISO/TS 28037", "--out", pdf, "--out", html)
    done = run(*CONFORMITY, *more, "--json")
    assert done.status == 0, done.err
    rows = done.data["rows"]
    clauses = {row["clause"] for row in rows}
    assert clauses >= {"7.3", "7.4", "8.3.2", "9.5", "H.3", "6.3, example 1"}
    assert all(row["passed"] for row in rows) and "FAILED" not in html.read_text("utf-8")
    page = html.read_text("utf-8")
    digest = done.data["installation"]["SHA-256 of the certified data"]
    assert all(text in page for text in ("8.3.2", "Breakdown voltage", "Not answered", digest))
    assert pdf.read_bytes().startswith(b"%PDF")


def test_value_that_is_not_met_fails_with_status_1(tmp_path, monkeypatch) -> None:
    wrong = deepcopy(validation_record.load_clauses())
    (clause,) = (c for c in wrong["clauses"] if (c["standard"], c["clause"]) == JCGM_106)
    clause["rows"][0][2] += 0.01
    monkeypatch.setattr(validation_record, "load_clauses", lambda: wrong)
    done = run(*CONFORMITY, "--out", tmp_path / "validation.html")
    assert done.status == 1 and "1 of 7 values" in done.err
    assert (tmp_path / "validation.html").read_text("utf-8").count("FAILED") == 1


def test_refused_example_fails_its_values(monkeypatch) -> None:
    wrong = deepcopy(validation_record.load_clauses())
    for clause in wrong["clauses"]:
        clause["given"]["limit"] = "no limit"
    monkeypatch.setattr(validation_record, "load_clauses", lambda: wrong)
    done = run(*CONFORMITY)
    assert done.status == 1 and "7 of 7 values" in done.err


@pytest.mark.parametrize("option", ["--standard=ISO 9001", "--out=validation.docx"])
def test_unknown_standard_or_format_is_status_2(option) -> None:
    done = run("validate", option)
    assert done.status == 2 and "Traceback" not in done.err


@pytest.mark.slow
def test_every_clause_is_met(tmp_path) -> None:
    done = run("validate", "--out", tmp_path / "validation.pdf", "--json")
    assert done.status == 0, [row for row in done.data["rows"] if not row["passed"]]
    assert len(done.data["nist"]) == 38
