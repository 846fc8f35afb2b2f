"""Pictures, as functions that return Matplotlib figures: `bc.plot.residuals(calibration)`, ….

Colours that the colour-blind can tell apart (Okabe and Ito), a unit on every axis.
"""

from __future__ import annotations

from bayescal._report.plots import allan as allan
from bayescal._report.plots import loop as loop
from bayescal._report.plots import missing as missing
from bayescal._report.plots import noise as noise
from bayescal._report.plots import residuals as residuals
from bayescal._report.plots import save as save
from bayescal._report.plots import sphere as sphere
from bayescal._report.plots import trail as trail
