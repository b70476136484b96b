"""The command line: what it writes, what it says, and that a mistake gets one line."""

import logging
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from shutil import copytree
from typing import Any

import numpy as np
import pymc as pm
import pytest
import xarray as xr

import prbayes as prb
from prbayes._finding import Finding, as_json
from prbayes.cli import main


def run(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "prbayes", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    return subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=cwd, env=environment
    )


@cache
def calibrated() -> tuple[pm.Model, Any, prb.Optimum]:
    observed = np.linspace(-1.0, 6.0, 10)
    with pm.Model() as model:
        x = pm.Normal.dist(pm.Normal("mu", 0, 2), 1.0)
        prb.Simulator("y", double, x, metric=prb.KullbackLeibler(), observed=observed)
    return model, x, prb.minimize(model, starts=0, progressbar=False)


def double(x: Any) -> Any:
    return 2 * x


@cache
def results() -> dict[str, xr.DataTree | xr.Dataset]:
    model, x, optimum = calibrated()
    settings = {"model": model, "random_seed": 1, "progressbar": False}
    posterior = prb.sample_smc(100, chains=2, optimum=optimum, **settings)
    later = prb.predict(posterior, double, x, **settings)
    test = prb.area_test(np.array([1.0, 2.0, 3.0]), later, null=prb.validation.PosteriorNull(199))
    return {"p.nc": posterior, "o.nc": optimum.to_datatree(), "v.nc": test.to_dataset()}


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved")
    for name, tree in results().items():
        tree.to_netcdf(path / name, engine="h5netcdf")
    return path


@pytest.fixture
def folder(saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    copytree(saved, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


REPORT = ("report", "p.nc", "o.nc", "v.nc", "--title", "A < B", "--date", "2 May")
WRITTEN = ("--out", "r.html", "--no-pictures")


@pytest.mark.slow
def test_the_command_is_a_program(folder: Path) -> None:
    done = run(*REPORT, *WRITTEN, cwd=folder)
    assert (done.returncode, done.stdout, done.stderr) == (0, "r.html\n", "")
    assert (folder / "r.html").stat().st_size > 5000


def test_report_of_saved_results(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*REPORT, *WRITTEN]) == 0
    assert capsys.readouterr() == ("r.html\n", "")
    text = (folder / "r.html").read_text(encoding="utf-8")
    assert "<h1>A &lt; B</h1>" in text
    for title in ("Decision", "Answer", "Evidence", "Method", "Diagnostics", "Appendix"):
        assert f">{title}</h2>" in text
    draws = results()["p.nc"]["posterior"]["mu"].values
    numbers = [f"{x:.2f}" for x in (draws.mean(), draws.std(ddof=1))]
    assert re.search(r"\D{1,80}".join(["mu", *numbers]), text)


def test_markdown_and_defaults(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", "p.nc", "--markdown", "md", "--no-pictures"]) == 0
    assert capsys.readouterr().out == f"{Path('md', 'report.md')}\n"
    assert (folder / "md" / "report.md").read_text(encoding="utf-8").startswith("# p\n")
    assert not (folder / "report.html").exists()
    assert main(["report", "p.nc", "--no-pictures"]) == 0
    assert capsys.readouterr().out == "report.html\n"
    assert (folder / "report.html").stat().st_size > 5000


def test_no_file_is_replaced_without_force(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "md").mkdir()
    (folder / "md" / "other.txt").write_text("not of a report")
    asked = ["report", "v.nc", "--markdown", "md", "--out", "r.html", "--no-pictures"]
    assert main(asked) == 0
    for name in ("r.html", "md/report.md", "md/02-picture.jpg", "results.svg"):
        path = folder / name
        for old in (folder / "r.html", folder / "md" / "report.md", path):
            old.unlink(missing_ok=True)
        path.write_text("old")
        is_free = name == "results.svg"
        assert main(asked) == (0 if is_free else 2)
        assert is_free or f"{Path(name)}: got a file that exists" in capsys.readouterr().err
        assert path.read_text(encoding="utf-8") == "old"
        assert main([*asked, "--force"]) == 0
        if name.endswith(("html", "md")):
            assert path.stat().st_size > 500
        else:
            path.unlink()
    before = (folder / "v.nc").read_bytes()
    assert main(["report", "v.nc", "--out", "./v.nc", "--force"]) == 2
    assert "got the path of results" in capsys.readouterr().err
    assert (folder / "v.nc").read_bytes() == before


def test_several_posteriors_are_compared_by_the_names_of_their_files(folder: Path) -> None:
    (folder / "b").mkdir()
    for name in ("q.nc", "b/p.nc"):
        (folder / name).write_bytes((folder / "p.nc").read_bytes())
    assert (
        main(["report", "p.nc", "q.nc", "b/p.nc", "p.nc", "--no-pictures", "--markdown", "md"]) == 0
    )
    text = (folder / "md" / "report.md").read_text(encoding="utf-8")
    other = Path("b", "p.nc")
    for label in ("p.nc", "q", str(other)):
        assert f"## Posterior: {label}\n" in text
    assert text.count("## Posterior: ") == 3


def test_a_saved_validity_test_comes_back_whole(folder: Path) -> None:
    from prbayes.cli import _opened, _validity_test

    found = _validity_test(Path("v.nc"), _opened(Path("v.nc")).to_dataset()).to_dataset()
    xr.testing.assert_identical(found.drop_attrs(), results()["v.nc"].drop_attrs())
    assert found.attrs["null"] == results()["v.nc"].attrs["null"]


@cache
def decisions() -> dict[str, xr.Dataset]:
    _, x, optimum = calibrated()
    quantity, condition = prb.decision.Mean(double, x), prb.decision.Condition(double, x)
    return {
        "above 7.nc": prb.exceedance(optimum, double, 7.0, x, requirement=0.5),
        "mean.nc": prb.sensitivity(optimum, quantity, n_points=64),
        "more.nc": prb.plan(optimum, {"here": condition}, k=[5], quantity=quantity),
    }


def test_saved_decisions_are_reported(folder: Path) -> None:
    for name, table in decisions().items():
        table.to_netcdf(folder / name, engine="h5netcdf")
    given = ["o.nc", *decisions()]
    assert main(["report", *given, "--no-pictures", "--markdown", "md"]) == 0
    text = (folder / "md" / "report.md").read_text(encoding="utf-8")
    for title in ("Probability beyond a limit", "What moves it", "What more data would change"):
        assert f"### {title}\n" in text
    assert "### \u2713 Requirement met\n" in text
    assert "allowed: at most 50%" in text
    assert "above 7" in text
    assert "mean of double" in text
    assert "prb.exceedance" not in text


def test_mistakes_get_one_line_and_exit_code_2(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def write(name: str, tree: xr.DataTree | xr.Dataset) -> None:
        tree.to_netcdf(folder / name, engine="h5netcdf")

    (folder / "text.nc").write_text("no netCDF")
    (folder / "cut.nc").write_bytes((folder / "p.nc").read_bytes()[:5000])
    write("other.nc", xr.Dataset({"a": 1.0}))
    write("u.nc", xr.Dataset({"u": 1.0}))
    write("damaged.nc", decisions()["above 7.nc"].drop_vars("lower"))
    draws = np.random.default_rng(1).normal(size=(2, 50))
    stranger = xr.Dataset({"nu": (("chain", "draw"), draws)})
    for name, posterior in (("nodims.nc", xr.Dataset({"mu": 1.0})), ("stranger.nc", stranger)):
        write(name, xr.DataTree.from_dict({"posterior": posterior}))
    cases = [
        (["missing.nc"], "missing.nc: got no such file"),
        (["."], "got no such file"),
        (["text.nc"], "no netCDF file that can be read"),
        (["cut.nc"], "no netCDF file that can be read"),
        (["other.nc"], "expected results of prbayes"),
        (["u.nc"], "expected a validity test"),
        (["nodims.nc"], "without the dimensions"),
        (["p.nc", "stranger.nc"], "share no hyperparameter"),
        (["o.nc", "damaged.nc"], "lower"),
        (["p.nc", "--out", "p.nc/report.html"], "cannot write"),
        (["p.nc", "--markdown", "p.nc"], "cannot write: folder: got"),
        (["p.nc", "--title", " "], "title"),
    ]
    for arguments, message in cases:
        assert main(["report", *arguments, "--no-pictures"]) == 2, arguments
        out, err = capsys.readouterr()
        assert out == ""
        assert message in err, arguments
        assert err.startswith("prbayes: ")
        assert err.count("\n") == 1
    assert not (folder / "report.html").exists()


def test_nothing_read_is_executed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tree = results()["p.nc"].copy()
    assert isinstance(tree, xr.DataTree)
    tree["posterior"].attrs["model"] = "__import__('pathlib').Path('owned').touch()"
    tree["posterior"].attrs["findings"] = as_json(
        [Finding("not-identified", "<script>alert(1)</script> | is here")]
    )
    tree.to_netcdf(folder / "bad.nc", engine="h5netcdf")
    assert main(["report", "bad.nc", "--no-pictures"]) == 0
    assert "<script" not in (folder / "report.html").read_text(encoding="utf-8")
    assert not (folder / "owned").exists()


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, expected in (
        (["--help"], "report"),
        (["report", "--help"], "prbayes report results.nc optimum.nc validity.nc --title"),
        (["--version"], f"prbayes {prb.__version__}"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 0
        assert expected in capsys.readouterr().out
    for arguments in ([], ["report"], ["nothing"]):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
        assert "usage:" in capsys.readouterr().err


@pytest.mark.parametrize(("options", "level"), [([], logging.INFO), (["-q"], logging.WARNING)])
def test_what_is_logged_goes_to_stderr(
    options: list[str], level: int, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", "v.nc", "--out", "r.html", "--no-pictures", *options]) == 0
    logging.getLogger("prbayes").info("sampling")
    assert logging.getLogger("prbayes").level == level
    assert capsys.readouterr() == ("r.html\n", "" if options else "prbayes: sampling\n")


def test_help_is_there_before_anything_heavy_is_loaded() -> None:
    code = (
        "import sys\n"
        "from prbayes.cli import main\n"
        "try:\n"
        "    main(['--help'])\n"
        "except SystemExit:\n"
        "    pass\n"
        "heavy = {'pymc', 'pytensor', 'xarray', 'numpy', 'scipy'}\n"
        "assert not heavy & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
