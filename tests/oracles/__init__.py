"""Reference computations that share no code with the package."""
