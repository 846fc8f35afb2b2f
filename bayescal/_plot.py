"""Pictures, as functions that return Matplotlib figures: `bc.plot.residuals(calibration)`, ….

Colours that the colour-blind can tell apart (Okabe and Ito), a unit on every axis.
"""

from __future__ import annotations

from bayescal._plot_error import loop as loop
from bayescal._plot_error import missing as missing
from bayescal._plot_error import trail as trail
from bayescal._plot_posterior import coefficients as coefficients
from bayescal._plot_posterior import identifiability as identifiability
from bayescal._plot_posterior import members as members
from bayescal._plot_posterior import pairs as pairs
from bayescal._plot_posterior import predictive as predictive
from bayescal._plot_residuals import residuals as residuals
from bayescal._plot_style import save as save
