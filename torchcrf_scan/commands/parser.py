"""The argument parser of all commands: a mistyped option is answered with the nearest one."""

from __future__ import annotations

from typing import NoReturn

from torchcrf_scan.experiment.parser import SettingsParser

ALIKE = 60.0  # of 100, the least likeness of an option that may have been meant
UNKNOWN = "unrecognized arguments: "


class CommandParser(SettingsParser):
    """A parser that suggests options."""

    def error(self, message: str, ex: Exception | None = None) -> NoReturn:
        """Ends with a usage error; an unknown option is told with the nearest right one of the command."""
        if message.startswith(UNKNOWN):
            parser = getattr(ex, "subcommand_parser", None) or self
            message += meant(
                message.removeprefix(UNKNOWN).split(),
                [option for option in parser._option_string_actions if option.startswith("--")],
            )
        super().error(message, ex)


def meant(words: list[str], options: list[str]) -> str:
    """The end of a message about unknown words: for every option among them the nearest of the right ones, if it is near."""
    from rapidfuzz import fuzz, process

    unknown = [word.split("=")[0] for word in words if word.startswith("--")]
    found = [(word, process.extractOne(word, options, scorer=fuzz.ratio, score_cutoff=ALIKE)) for word in unknown]
    hints = [f"{near[0]} instead of {word}" for word, near in found if near is not None]
    return f" (did you mean {', '.join(hints)}?)" if hints else ""
