"""A palette distinguishable with colour vision deficiency, for all plots and the workbench.

Source: M. Okabe and K. Ito, "Color universal design" (2008).
"""

BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
SKY, PURPLE, PALE, GREY = "#56B4E9", "#CC79A7", "#B0B0B0", "#7A7A7A"
CYCLE = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
