"""``avsreplay completion``: prints the script with which a shell completes commands and options."""

from __future__ import annotations

import click
from click.shell_completion import get_completion_class

from avsreplay.errors import UsageError

EPILOG = """\b
Examples:
  eval "$(avsreplay completion bash)"                              in ~/.bashrc
  eval "$(avsreplay completion zsh)"                               in ~/.zshrc
  avsreplay completion fish > ~/.config/fish/completions/avsreplay.fish"""


@click.command("completion", epilog=EPILOG)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion_command(shell: str) -> None:
    """Print the completion script for SHELL.

    \f
    Raises:
        UsageError: the shell is not supported.
    """  # noqa: D301
    from avsreplay.cli import group

    found = get_completion_class(shell)
    if found is None:
        raise UsageError(f"no completion for {shell}", where="completion", hint="use bash, zsh or fish")
    click.echo(found(group, {}, "avsreplay", "_AVSREPLAY_COMPLETE").source())
