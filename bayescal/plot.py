"""Pictures, as functions that return Matplotlib figures: `bc.plot.residuals(calibration)`, ….

Colours that the colour-blind can tell apart (Okabe and Ito), a unit on every axis.
"""

from __future__ import annotations

from bayescal._plots.allan import allan as allan
from bayescal._plots.posterior import coefficients as coefficients
from bayescal._plots.posterior import identifiability as identifiability
from bayescal._plots.posterior import members as members
from bayescal._plots.posterior import pairs as pairs
from bayescal._plots.posterior import predictive as predictive
from bayescal._plots.residuals import residuals as residuals
from bayescal._plots.search import loop as loop
from bayescal._plots.search import missing as missing
from bayescal._plots.search import trail as trail
from bayescal._plots.style import save as save
