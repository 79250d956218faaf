"""What long work says about itself while it is done."""


class Progress:
    """Told what is being done and how far it is; this one keeps it to itself."""

    def step(self, message: str) -> None:
        """Begin a step; the one before it is done."""

    def advance(self, done: int, of: int) -> None:
        """Say how much of the step is done."""


QUIET = Progress()
