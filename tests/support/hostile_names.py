"""Names of columns that nobody should give, and somebody does."""

from __future__ import annotations

HOSTILE = (
    "a/b", "/", "../../etc/passwd", "<b>bold</b>", "<script>alert(1)</script>", "</script><script>",
    "<img src=x onerror=y>", "it's", 'say "so"', "`id`", "$(id)", "${HOME}", "; rm -rf x", "a|b", "a&b", "&amp;",
    "%2F", "100%", "a\\b", "C:\\temp", "tab\tin it", "x" * 200, "δ" * 60, "--out", "-h", "a, b", "a=b", "[x]", "{0}",
    "{x!r}", "unknown(time)", "time, jump", "bias.constant", "posterior", "mode", "x\u202ereversed",
    "é\u0301 combined", "draws", "# comment", "__class__", "null", "nan", "e+05",
)  # fmt: skip
