"""Help that fits a screen: what experts need works without being listed, and ``--help-all`` lists it."""

import argparse
from typing import Any, NoReturn

from selfcorrect.cli.terminal import show
from selfcorrect.errors import SettingsError

__all__ = ["Expert", "Parser", "add_help_all"]


class Expert(str):
    """Help of a flag that only ``--help-all`` lists: ``parser.add_argument("--flag", help=Expert("…"))``."""

    __slots__ = ()


class Parser(argparse.ArgumentParser):
    """Short help, and one line for a wrong flag, like for every other wrong input."""

    def format_help(self) -> str:
        """Help without the experts' flags."""
        self.usage = self.usage or self._short_usage()
        hidden = [(action, action.help) for action in self._actions if isinstance(action.help, Expert)]
        for action, _ in hidden:
            action.help = argparse.SUPPRESS
        try:
            return super().format_help()
        finally:
            for action, text in hidden:
                action.help = text

    def _short_usage(self) -> str:
        """What must be given; all else is in the list below it."""
        required = [action for action in self._actions if action.required or not action.option_strings]
        formatter = argparse.HelpFormatter(self.prog)
        formatter.add_usage(None, required, (), prefix="")
        return " ".join([*formatter.format_help().split(), "[flags]"]).replace("%", "%%")

    def format_help_all(self) -> str:
        """Help with all flags."""
        self.usage = self.usage or self._short_usage()
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Raise what the command tells in one line."""
        raise SettingsError(f"{message}; see {self.prog} --help")


class _HelpAll(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        assert isinstance(parser, Parser)
        show(*parser.format_help_all().splitlines())
        parser.exit()


def add_help_all(parser: argparse.ArgumentParser) -> None:
    """The flag ``--help-all``."""
    parser.add_argument("--help-all", action=_HelpAll, nargs=0, help="this, and the flags for experts")
