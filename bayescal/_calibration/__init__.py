"""What a fit is: the verbs `fit`, `load`, `predict`, `check` and `compare`; draws with names, storage, guards."""
