"""What a user did wrong, said in one line. Imports nothing, so that commands can load it at once."""


class InputError(ValueError):
    """An argument, file or setting from outside is not usable; commands print it and exit with 2."""


class ShapeError(InputError):
    """A tensor has the wrong trailing shape."""


class NotFiniteError(InputError):
    """Numbers that must be finite are NaN or infinite."""


class SingularLawError(InputError):
    """A law that is spread over fewer directions than its space has no density to evaluate."""
