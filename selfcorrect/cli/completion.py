"""The command `completion`: what makes a shell complete commands, flags and names, with no Python at each tab."""

import argparse
from typing import Any

import denoisers
from selfcorrect.cli.help import Expert
from selfcorrect.cli.terminal import show
from selfcorrect.settings import Settings

__all__ = ["add"]

_SCRIPT = """\
_selfcorrect() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" words=""
    case "${{COMP_WORDS[COMP_CWORD-1]}}" in
{values}
    *)
        if [ "$COMP_CWORD" -eq 1 ]; then
            words="{commands}"
        elif [ "${{word#-}}" != "$word" ]; then
            case "${{COMP_WORDS[1]}}" in
{flags}
            esac
        fi ;;
    esac
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _selfcorrect selfcorrect"""

_ZSH = "autoload -Uz compinit bashcompinit && compinit && bashcompinit"


def add(commands: Any) -> None:
    """Add the command to argparse's subparsers, after all others."""
    parser = commands.add_parser("completion", help="what makes bash or zsh complete this command")
    parser.add_argument("shell", choices=("bash", "zsh"), help='for ~/.bashrc: eval "$(selfcorrect completion bash)"')
    parser.set_defaults(run=lambda options: _completion(options, commands.choices))


def _completion(options: argparse.Namespace, parsers: dict[str, argparse.ArgumentParser]) -> None:
    names = [name for name in denoisers.names() if name.replace(":", "").replace("-", "").isalnum()]
    values = {"--preset": Settings.presets(), "--denoiser": names}
    flags = {name: _flags(parser) for name, parser in parsers.items()}
    script = _SCRIPT.format(
        commands=" ".join(parsers),
        values="\n".join(f'    {flag}) words="{" ".join(known)}" ;;' for flag, known in values.items()),
        flags="\n".join(f'            {name}) words="{" ".join(known)}" ;;' for name, known in flags.items()),
    )
    show(*(script if options.shell == "bash" else f"{_ZSH}\n{script}").splitlines())


def _flags(parser: argparse.ArgumentParser) -> list[str]:
    """The flags that short help lists."""
    shown = [action for action in parser._actions if not isinstance(action.help, Expert)]
    return [flag for action in shown for flag in action.option_strings if flag.startswith("--")]
