"""`stickslip completion`: how a shell completes the command."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

from stickslip.workflows.commands.command import DONE, Command
from stickslip.workflows.scenes import shipped


class Completion(Command):
    """`stickslip completion`."""

    name = "completion"
    words = "print a completion script for a shell"
    examples = (
        ('eval "$(stickslip completion bash)"', "in ~/.bashrc"),
        ('eval "$(stickslip completion zsh)"', "in ~/.zshrc, after compinit"),
        ("stickslip completion fish | source", "in ~/.config/fish/config.fish"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("shell", choices=("bash", "zsh", "fish"), metavar="SHELL", help="bash, zsh or fish")

    def __call__(self, arguments: argparse.Namespace) -> int:
        print(script(arguments.parser, arguments.shell))
        return DONE


def script(parser: argparse.ArgumentParser, shell: str) -> str:
    """A script by which a shell completes the command: commands, options, names of scenes, files and directories."""
    import shtab

    names = " ".join(shipped())
    complete: dict[str, Any] = {
        "DIR": shtab.DIRECTORY,
        "FILE": shtab.FILE,
        "SCENE": {
            "bash": "_stickslip_scene",
            "zsh": "_stickslip_scene",
            "fish": f"(string split ' ' '{names}'; __fish_complete_suffix .toml)",
            "preamble": {
                "bash": '_stickslip_scene() { compgen -W "' + names + "\" -- $1; compgen -f -X '!*.toml' -- $1;"
                " compgen -d -- $1; }\n",
                "zsh": f"_stickslip_scene() {{ compadd {names}; _files -g '*.toml' }}\n",
            },
        },
    }
    for action in _actions(parser):
        if action.metavar in complete:
            action.complete = complete[str(action.metavar)]  # type: ignore[attr-defined]  # shtab looks for it
    return str(shtab.complete(parser, shell=shell))


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from _actions(sub)
