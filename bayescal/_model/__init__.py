"""Models: priors, coefficients, effects, noise laws, instruments, and their one composition."""
