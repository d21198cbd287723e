"""Options of the command-line programs."""

import sys
from pathlib import Path

import draccus
from draccus.utils import DecodingError, ParsingError


def parse_options[Options](config_class: type[Options]) -> Options:
    """Read the command line into a dataclass; an option that does not fit ends the program.

    Args:
        config_class: The dataclass; the ValueErrors of its ``__post_init__`` are shown.
    """
    try:
        return draccus.parse(config_class=config_class)
    except ParsingError as error:
        # What an option's own type says is in the message, what a dataclass says is its cause.
        reason = error if isinstance(error, DecodingError) else error.__cause__ or error
        sys.exit(f"{Path(sys.argv[0]).name}: {reason}")
