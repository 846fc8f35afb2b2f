"""Pictures, as functions that return Matplotlib figures: `bc.plot.residuals(calibration)`, ….

Colours that the colour-blind can tell apart (Okabe and Ito), a unit on every axis.
"""

from __future__ import annotations

from bayescal._report.plot_allan import allan as allan
from bayescal._report.plot_allan import noise as noise
from bayescal._report.plot_posterior import coefficients as coefficients
from bayescal._report.plot_posterior import identifiability as identifiability
from bayescal._report.plot_posterior import members as members
from bayescal._report.plot_posterior import pairs as pairs
from bayescal._report.plot_posterior import predictive as predictive
from bayescal._report.plot_residuals import residuals as residuals
from bayescal._report.plot_search import loop as loop
from bayescal._report.plot_search import missing as missing
from bayescal._report.plot_search import trail as trail
from bayescal._report.plot_sphere import sphere as sphere
from bayescal._report.plot_style import save as save
