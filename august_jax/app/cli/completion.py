"""What completes ``august`` in a shell: commands, options, the choices of options, and overrides by section and field.

The script is printed by ``august --completion bash`` and read by ``eval "$(august --completion bash)"``; zsh reads the
same by its own emulation of bash's.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

SHELLS = ("bash", "zsh")

_SCRIPT = """\
_august() {
  local word="${COMP_WORDS[COMP_CWORD]}" before="${COMP_WORDS[COMP_CWORD-1]}" command="${COMP_WORDS[1]}" words=""
  COMPREPLY=()
  if [ "$COMP_CWORD" -eq 1 ]; then
    COMPREPLY=($(compgen -W "@COMMANDS@ --help --version --completion" -- "$word"))
    return
  fi
  case "$command $before" in
@CHOICES@
    *) case "$command" in
@OPTIONS@
      esac
      case "$word" in -*) ;; *.*) words="@FIELDS@" ;; esac ;;
  esac
  COMPREPLY=($(compgen -W "$words" -- "$word"))
  case "${COMPREPLY[0]}" in *=) type compopt > /dev/null 2>&1 && compopt -o nospace ;; esac
}
complete -o default -F _august august"""


def completion(parsers: Mapping[str, argparse.ArgumentParser], shell: str) -> str:
    """The script for a shell of :data:`SHELLS`, from the parsers of all commands."""
    from august_jax import config as configuration

    choices, options = [], []
    for name, parser in parsers.items():
        flags = [max(action.option_strings, key=len) for action in parser._actions if action.option_strings]
        options.append(f'      {name}) words="{" ".join(flags)}" ;;')
        for action in parser._actions:
            known = getattr(action.type, "known", None) or action.choices
            given = configuration.PRESETS if action.dest == "preset" else known
            if action.option_strings and given:
                taken = " ".join(map(str, given))
                choices.append(f'    "{name} {max(action.option_strings, key=len)}") words="{taken}" ;;')
    fields = " ".join(f"{field.path}=" for field in configuration.describe())
    script = (
        _SCRIPT.replace("@COMMANDS@", " ".join(parsers))
        .replace("@CHOICES@", "\n".join(choices))
        .replace("@OPTIONS@", "\n".join(options))
        .replace("@FIELDS@", fields)
    )
    return ("autoload -U +X compinit bashcompinit && compinit && bashcompinit\n" if shell == "zsh" else "") + script
