"""Leave-one-out: the recordings of a data set but for those that are tested on."""

from collections.abc import Sequence

from vioframe.data.recording import Dataset, Recording
from vioframe.data.selection import as_names
from vioframe.errors import ConfigError, DataError


class RemainingSequences(Dataset):
    """Another data set without some of its sequences, all that remain or the last few of them.

    Args:
        source: the data set.
        leave_out: names of sequences, as the data set or YAML writes them (``07``, ``7``); None leaves out none. A
            name means all stretches of that recording.
        skip_last: leave out as many at the end of what remains too, which validation may have.
        only_last: take as many at the end and no others; None takes all.

    Raises:
        ConfigError: numbers that cannot be.
        DataError: nothing remains.
    """

    def __init__(
        self,
        *,
        source: Dataset,
        leave_out: str | int | Sequence[str | int] | None = None,
        skip_last: int = 0,
        only_last: int | None = None,
    ) -> None:
        if not isinstance(source, Dataset):
            raise ConfigError(f"training_data: source must be a data set, got {type(source).__name__}")
        if skip_last < 0 or (only_last is not None and only_last < 1):
            raise ConfigError(
                f"training_data: skip_last must be 0 or more and only_last 1 or more, got {skip_last} and {only_last}"
            )
        left = {_plain(name) for name in as_names(leave_out)}
        names = [name for name in source.sequences if _plain(name) not in left]
        names = names[: len(names) - skip_last] if only_last is None else names[-only_last:]
        if not names:
            raise DataError(
                f"no recording remains to learn from: of {', '.join(source.sequences)} training_data.leave_out takes "
                f"{', '.join(as_names(leave_out)) or 'none'}, and {skip_last} are kept for validation"
            )
        self._source = source
        self._names = names

    @property
    def sequences(self) -> Sequence[str]:
        """Those that remain, in the order of the source."""
        return self._names

    def open(self, sequence: str) -> Recording:
        """Open and check one; errors as of the source."""
        return self._source.open(sequence)


def _plain(name: str) -> str:
    """The recording that a name is of: without stretch, and without the zeros that YAML takes from a number."""
    whole = name.partition(".")[0]
    return whole.lstrip("0") or "0" if whole.isdigit() else whole
