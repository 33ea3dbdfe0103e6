"""One short script a question; `python -m experiments.NAME --help` says which."""
