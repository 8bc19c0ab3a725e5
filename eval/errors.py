"""The one family of errors that evaluation raises on purpose, each with one line of text."""


class EvalError(Exception):
    """Base class of all errors raised on purpose by eval."""


class FileError(EvalError):
    """A file to be judged is missing, unreadable or not what its name says."""


class AssociationError(EvalError):
    """Estimate and reference have too little in common to be compared."""


class AlignmentError(EvalError):
    """The alignment asked for is unknown or has no solution."""


class EvidenceError(EvalError):
    """The evidence lacks what a metric asks of it."""


class MetricError(EvalError):
    """A metric can't be made from its settings, or breaks the contract of `eval.metrics.metric`."""
