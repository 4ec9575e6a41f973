"""What the completion scripts of both programs have to do, whichever shell reads them."""

import re
import shutil
import subprocess
from pathlib import Path

from survey.commands.completion import commands_of, completion_script
from survey.commands.parser import Parser


def bash_completes(parser: Parser, folder: Path, words: list[str], expected: list[str]) -> None:
    """What bash offers for the last of ``words``, of which the first is the program."""
    script = folder / "completion"
    script.write_text(completion_script(parser, "bash"))
    quoted = " ".join(f"'{w}'" for w in words)
    code = f"source {script}; COMP_WORDS=({quoted}); COMP_CWORD={len(words) - 1}; _{words[0]}; echo ${{COMPREPLY[@]}}"
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert done.stdout.split() == expected


def names_every_command_and_parses(parser: Parser, shell: str, script: str, folder: Path) -> None:
    """Every command and flag is in it; the shell takes it, where there is that shell."""
    for command in commands_of(parser):
        assert re.search(rf"\b{command.name}\b", script)
        assert all(flag.names[-1].lstrip("-") in script for flag in command.flags)
    if shutil.which(shell):
        (folder / "s").write_text(script)
        subprocess.run([shell, "-n", str(folder / "s")], check=True)
