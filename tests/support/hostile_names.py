"""Names that nobody should give, and somebody does."""

from __future__ import annotations

HOSTILE = (
    "a/b", "/", "../../etc/passwd", "<b>bold</b>", "<script>alert(1)</script>", "</script><script>",
    "<img src=x onerror=y>", "it's", 'say "so"', "`id`", "$(id)", "${HOME}", "; rm -rf x", "a|b", "a&b", "&amp;",
    "%2F", "100%", "a\\b", "C:\\temp", "tab\tin it", "x" * 200, "δ" * 60, "--out", "-h", "a, b", "a=b", "[x]", "{0}",
    "{x!r}", "unknown(time)", "time, jump", "bias.constant", "posterior", "mode", "x\u202ereversed",
    "é\u0301 combined", "draws", "# comment", "__class__", "null", "nan", "e+05",
)  # fmt: skip

# Pieces that mean something to C, Python, HTML, XML, spreadsheets, and to the programs that write these.
PIECES = (
    "*/", "/*", "*\\ ", "\\", "\\\n", "??/", "??)", "//", "#define x", '"', '"""', "'", "\x00",
    "\x1b[2J", "\x7f", "<", ">", "<script>alert(1)</script>", "<img src=x onerror=alert(1)>",
    "&lt;", "&", "]]>", "-->", "<!--", "{{ 7*7 }}", "{% raw %}", "${x}", "%s", "{0}", "=1+1", "+1",
    "-1", "@SUM(A1)", "\t=1", "\r\n", ",", ";", "\u2028", "\u202e", "\ufeff", "\ud800", "\uffff",
    "é", "漢", "int f(void){return 1;}", "system('x')", "\n#", "import os", "NAN", "in", "range",
    "t0", "reading", "0", " ",
)  # fmt: skip

# Names that would be code, markup, formulas or words of an export, were they written as they are.
CODE = (
    "gyro*\\ int f(void){return 1;}\\*.csv", '"""\nimport os\nos.system("x")\n"""',
    "*\\/ int x; /*", "a ??/\n int x;", '</title><script>alert(1)</script>"onload="x',
    "=cmd|'/c calc'!A1", "a*/int evil(void);/*b", "*\\", "/", "*", "??/", "??/\\", "\\\nint x;",
    "//", "\r*/ int x; //", "\x0b*/\x0c#include <x>", "#define fabs(x) system(x)", "_Pragma(x)",
    "%:define x", "fabs", "NAN", "INFINITY", "unix", "errno", "reading", "stimulus", "inputs",
    "values", "slope", "math", "range", "lambda", "t0", "__import__('os')", "{{ config }}",
    "{% include x %}", "'''", '\\"""', "\u2028import os\u2029", "# -*- coding: utf-7 -*-", "\ufeff",
    "\u202egnp.cvs", "", "\x00",
)  # fmt: skip
