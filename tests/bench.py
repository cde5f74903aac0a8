"""Models that a test writes down part by part."""

from problems import compiled

from jaxonomy_dae import EqnEnv


class Bench:
    """Components of one model, and the ports joined in it."""

    def __init__(self):
        self.ev, self.parts, self.joined = EqnEnv(), [], []

    def __call__(self, kind, name, *args, **kwargs):
        self.parts.append(kind(self.ev, name, *args, **kwargs))
        return self.parts[-1]

    def join(self, *ends):
        self.joined.append(ends)

    def chain(self, *ends):
        """Joins ends in pairs."""
        for a, b in zip(ends[::2], ends[1::2], strict=True):
            self.join(a, b)

    def compile(self, **options):
        return compiled(*self.parts, connect=self.joined, **options)
