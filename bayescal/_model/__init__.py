"""Models: priors, coefficients, effects, noise laws, instruments, and the composition of their expected output."""
