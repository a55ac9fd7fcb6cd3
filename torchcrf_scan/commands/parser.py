"""The argument parser of all commands: bad usage is told in one line, a mistyped option with the nearest right one."""

from __future__ import annotations

import re
import sys
from typing import NoReturn

from torchcrf_scan.experiment.parser import SettingsParser

ALIKE = 60.0  # of 100, the least likeness of an option that may have been meant
UNKNOWN = "unrecognized arguments: "
MISTYPED = re.compile(r"Parser key \"(\S+)\":\s+Expected an? <class '(\w+)'>\. Got value: (.*)", re.DOTALL)
KINDS = {"int": "a whole number", "float": "a finite number", "bool": "true or false"}


class CommandParser(SettingsParser):
    """A parser whose errors are one line each."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Ends with exit code 2 and one line; an unknown option is told with the nearest right one of the command."""
        parser = getattr(ex, "subcommand_parser", None) or self
        if message.startswith(UNKNOWN):
            message += meant(
                message.removeprefix(UNKNOWN).split(),
                [option for option in parser._option_string_actions if option.startswith("--")],
            )
        if wrong := MISTYPED.fullmatch(message):
            name, kind, value = wrong.groups()
            message = f"--{name}: expected {KINDS.get(kind, kind)}, got {value}"
        if not self.exit_on_error:
            super().error(message, ex)
        program = parser.prog.replace(" [options]", "")
        print(f"{program}: error: {' '.join(message.split())} ({program} --help lists all options)", file=sys.stderr)
        raise SystemExit(2)


def meant(words: list[str], options: list[str]) -> str:
    """The end of a message about unknown words: for every option among them the nearest of the right ones, if it is near."""
    from rapidfuzz import fuzz, process

    unknown = [word.split("=")[0] for word in words if word.startswith("--")]
    found = [(word, process.extractOne(word, options, scorer=fuzz.ratio, score_cutoff=ALIKE)) for word in unknown]
    hints = [f"{near[0]} instead of {word}" for word, near in found if near is not None]
    return f" (did you mean {', '.join(hints)}?)" if hints else ""
