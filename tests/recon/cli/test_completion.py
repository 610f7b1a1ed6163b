"""The completions that shells offer with the script of ``lissajous completion``."""

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from recon.cli import COMMANDS, main


@pytest.fixture
def script(request: pytest.FixtureRequest, tmp_path: Path, capsys: pytest.CaptureFixture) -> Path:
    assert main(["completion", request.param]) == 0
    path = tmp_path / "script"
    path.write_text(capsys.readouterr().out)
    return path


def shell(name: str, *arguments: str, cwd: Path) -> list[str]:
    if shutil.which(name) is None:
        pytest.skip(f"no {name}")
    environment = os.environ | {"HOME": str(cwd), "XDG_CONFIG_HOME": str(cwd)}
    process = subprocess.run([name, *arguments], capture_output=True, text=True, check=True, cwd=cwd, env=environment)
    assert not process.stderr
    return process.stdout.split()


def bash_offers(script: Path, *words: str) -> list[str]:
    set_words = f"COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}"
    return shell("bash", "-c", f'. {script}; {set_words}; _lissajous; echo "${{COMPREPLY[@]}}"', cwd=script.parent)


@pytest.mark.parametrize("script", ["bash"], indirect=True)
def test_bash_completes_commands_options_and_choices(script: Path) -> None:
    assert bash_offers(script, "lissajous", "") == list(COMMANDS)
    assert bash_offers(script, "lissajous", "re") == ["reconstruct"]
    assert bash_offers(script, "/opt/bin/lissajous", "reconstruct", "--flip") == ["--flip-x", "--flip-y"]
    assert bash_offers(script, "reconstruct-from-recording", "--pix") == ["--pixels"]
    assert bash_offers(script, "lissajous", "convert", "--js") == ["--json"]
    assert bash_offers(script, "lissajous", "completion", "f") == ["fish"]
    assert bash_offers(script, "lissajous", "reconstruct", "--device", "") == []  # files, by complete -o default
    assert "-o" in bash_offers(script, "lissajous", "predict", "-")


@pytest.mark.parametrize("script", ["fish"], indirect=True)
def test_fish_completes_commands_options_and_files(script: Path) -> None:
    def offers(line: str) -> list[str]:
        return shell("fish", "-c", f"source {script}; complete -C '{line}' | cut -f 1", cwd=script.parent)

    (script.parent / "recording.h5").touch()
    assert set(offers("lissajous ")) == set(COMMANDS)
    assert offers("lissajous reconstruct --flip") == ["--flip-x", "--flip-y"]
    assert offers("reconstruct-from-recording --pix") == ["--pixels"]
    assert offers("lissajous completion ") == ["bash", "fish", "zsh"]
    assert offers("lissajous reconstruct rec") == ["recording.h5"]


# Runs zsh in a pseudo-terminal and prints what its line editor shows after two tabs.
ZSH = """
zmodload zsh/zpty
zpty z zsh -f -i
zpty -w z 'PS1= PS2=; autoload -U compinit; compinit -u -D; source SCRIPT; setopt autolist'
zpty -w z "bindkey '^I' expand-or-complete; print ready"
zpty -r z line '*ready*ready*'
zpty -w -n z $'LINE\\t\\t'
sleep 1
while zpty -r -t z line; do print -r -- $line; done
zpty -d z
"""


@pytest.mark.parametrize("script", ["zsh"], indirect=True)
def test_zsh_completes_commands_and_options(script: Path) -> None:
    def offers(line: str) -> str:
        text = ZSH.replace("SCRIPT", str(script)).replace("LINE", line)
        return " ".join(shell("zsh", "-f", "-c", text, cwd=script.parent))

    shell("zsh", "-n", str(script), cwd=script.parent)
    shown = offers("lissajous ")
    assert all(name in shown for name in COMMANDS)
    assert "even capacitance cannot know" in offers("reconstruct-from-recording --flip-")


def test_the_script_is_printed_without_large_imports() -> None:
    code = (
        "import sys; from recon.cli import main; main(['completion', 'bash']);"
        "assert not {'numpy', 'numba', 'scipy', 'h5py', 'matplotlib'} & set(sys.modules), sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)


def test_an_unknown_shell_is_refused_in_one_line(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["completion", "cmd"])
    assert stopped.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
