"""What is raised where an identification cannot be what it says."""

from collections.abc import Sequence


class IdentificationError(ValueError):
    """Data, parameters or settings do not fit the mechanism, or each other. `problems` lists every mistake, with its place."""

    def __init__(self, problems: Sequence[str], source: str = ""):
        self.problems, self.source = list(problems), source
        head = f"{source}: " if source else ""
        count = f"{len(self.problems)} mistakes in the identification:\n  "
        super().__init__(head + (self.problems[0] if len(self.problems) == 1 else count + "\n  ".join(self.problems)))

    def __reduce__(self):
        return type(self), (self.problems, self.source)
