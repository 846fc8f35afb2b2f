"""What a model is: priors, coefficients, effects, noise laws, instruments, and their one composition."""
