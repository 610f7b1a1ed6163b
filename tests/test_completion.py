"""What the shells offer once they have read the script of ``lissajous completion``."""

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
    done = subprocess.run([name, *arguments], capture_output=True, text=True, check=True, cwd=cwd, env=environment)
    assert not done.stderr
    return done.stdout.split()


def bash_offers(script: Path, *words: str) -> list[str]:
    asked = f"COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}"
    return shell("bash", "-c", f'. {script}; {asked}; _lissajous; echo "${{COMPREPLY[@]}}"', cwd=script.parent)


@pytest.mark.parametrize("script", ["bash"], indirect=True)
def test_bash(script: Path) -> None:
    assert bash_offers(script, "lissajous", "") == list(COMMANDS)
    assert bash_offers(script, "lissajous", "re") == ["reconstruct"]
    assert bash_offers(script, "/opt/bin/lissajous", "reconstruct", "--flip") == ["--flip-x", "--flip-y"]
    assert bash_offers(script, "reconstruct-from-recording", "--pix") == ["--pixels"]
    assert bash_offers(script, "lissajous", "convert", "--js") == ["--json"]
    assert bash_offers(script, "lissajous", "completion", "f") == ["fish"]
    assert bash_offers(script, "lissajous", "reconstruct", "--device", "") == []  # files, by complete -o default
    assert "-o" in bash_offers(script, "lissajous", "predict", "-")


@pytest.mark.parametrize("script", ["fish"], indirect=True)
def test_fish(script: Path) -> None:
    def offers(line: str) -> list[str]:
        return shell("fish", "-c", f"source {script}; complete -C '{line}' | cut -f 1", cwd=script.parent)

    (script.parent / "recording.h5").touch()
    assert set(offers("lissajous ")) == set(COMMANDS)
    assert offers("lissajous reconstruct --flip") == ["--flip-x", "--flip-y"]
    assert offers("reconstruct-from-recording --pix") == ["--pixels"]
    assert offers("lissajous completion ") == ["bash", "fish", "zsh"]
    assert offers("lissajous reconstruct rec") == ["recording.h5"]


# The line editor of a zsh in a terminal of its own is asked what it would show on the second tab.
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
def test_zsh(script: Path) -> None:
    def offers(line: str) -> str:
        text = ZSH.replace("SCRIPT", str(script)).replace("LINE", line)
        return " ".join(shell("zsh", "-f", "-c", text, cwd=script.parent))

    shell("zsh", "-n", str(script), cwd=script.parent)
    shown = offers("lissajous ")
    assert all(name in shown for name in COMMANDS)
    assert "even capacitance cannot know" in offers("reconstruct-from-recording --flip-")


def test_the_script_costs_no_heavy_import() -> None:
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
