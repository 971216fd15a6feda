"""What `jobs/deploy` offers to schedulers: looked at by what they themselves bring, where that is here.

kubernetes-validate is among the programs of others: $BORESIGHT_READERS names a Python that has it (`make readers`).
"""

import json
import os
import re
import shutil
import stat
import subprocess
import tomllib
from pathlib import Path

import pytest
from ruamel.yaml import YAML

REPO = Path(__file__).resolve().parents[2]
DEPLOY = REPO / "jobs" / "deploy"
SYSTEMD = DEPLOY / "systemd"
CRONJOB = DEPLOY / "kubernetes" / "cronjob.yaml"
RAYJOB = DEPLOY / "kubernetes" / "rayjob.yaml"
RETRIED = {0: False, 1: True, 2: False, 3: False}  # by the night's exit code


@pytest.fixture
def fake_night(tmp_path, monkeypatch):
    """A command that notes how it is called, tells a summary, and ends with a code that a test chooses."""
    command = tmp_path / "bin" / "boresight"
    command.parent.mkdir()
    command.write_text(
        '#!/bin/sh\nprintf "%s\\n" "$@" > "$NOTED"\necho \'{"command": "nightly", "status": "done", "held": 4}\'\n'
        "exit $CODE\n"
    )
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    settings = {"": command, "_FLEET": "/f/fleet.toml", "_LAKE": "/f/lake", "_LOGS": "/f/{vehicle}/{day}/*"}
    for name, value in settings.items():
        monkeypatch.setenv(f"BORESIGHT{name}", str(value))
    monkeypatch.setenv("NOTED", str(tmp_path / "noted"))
    return tmp_path / "noted"


def options_of(noted):
    """What the fake night was called with."""
    command, *rest = noted.read_text().splitlines()
    assert command == "nightly"
    return dict(zip(rest[::2], rest[1::2], strict=True))


def known(arguments):
    """Whether `boresight nightly` has all these options, spelled so."""
    from jobs.nightly import nightly

    names = {"from_day": "from", "to_day": "to"}
    options = {"--" + names.get(name, name).replace("_", "-") for name in nightly.__kwdefaults__ or {}}
    options |= {"--fleet", "--lake", "--logs"}
    return {a.partition("=")[0] for a in arguments if a.startswith("--")} <= options


# systemd and cron


def lines_of(unit):
    text = (SYSTEMD / unit).read_text().replace("\\\n", " ")
    return [x.partition("=")[::2] for x in text.splitlines() if "=" in x and not x.startswith("#")]


def test_systemd_tries_again_what_may_help_and_nothing_else():
    unit = dict(lines_of("boresight-night.service"))
    assert (unit["Type"], unit["Restart"]) == ("oneshot", "on-failure")
    assert (unit["SuccessExitStatus"], unit["RestartPreventExitStatus"]) == ("3", "2")


def test_systemd_itself_takes_the_units(tmp_path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not on this machine: apt-get install systemd")
    for unit in ("boresight-night.service", "boresight-night.timer"):
        shutil.copy(SYSTEMD / unit, tmp_path)
    service = tmp_path / "boresight-night.service"
    # Neither the user nor the file of settings is on a machine that only looks at the unit.
    service.write_text(
        service.read_text().replace("User=boresight", "").replace("=/etc/boresight/", "=-/etc/boresight/")
    )
    verify = ["systemd-analyze", "verify", "--man=no", *sorted(map(str, tmp_path.glob("boresight*")))]
    done = subprocess.run(verify, capture_output=True, text=True, check=False)
    ours = [line for line in done.stderr.splitlines() if "boresight" in line]
    assert (done.returncode, ours) == (0, []), done.stderr
    [when] = [value for key, value in lines_of("boresight-night.timer") if key == "OnCalendar"]
    subprocess.run(["systemd-analyze", "calendar", when], capture_output=True, check=True)


def shell_line_of_the_service():
    line = dict(lines_of("boresight-night.service"))["ExecStart"]
    return re.fullmatch(r"/bin/sh -c '(.*)'", line)[1].replace("%%", "%")


@pytest.mark.parametrize("code", RETRIED)
def test_the_services_command_is_the_nights_and_ends_with_its_code(code, fake_night, monkeypatch):
    monkeypatch.setenv("CODE", str(code))
    done = subprocess.run(["/bin/sh", "-c", shell_line_of_the_service()], capture_output=True, check=False)
    options = options_of(fake_night)
    assert done.returncode == code
    assert options["--logs"] == "/f/{vehicle}/{day}/*"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", options["--from"])
    assert known(options)


@pytest.mark.parametrize("code", [0, 1, 2])
def test_cron_mails_what_is_wrong_and_nothing_else(code, fake_night, monkeypatch, tmp_path):
    monkeypatch.setenv("CODE", str(code))
    [line] = [x for x in (SYSTEMD / "crontab").read_text().splitlines() if not x.startswith("#")]
    *when, user, command = line.split(maxsplit=6)
    assert (when, user) == (["30", "1", "*", "*", "*"], "boresight")
    for old, new in (
        ("\\%", "%"),
        ("/var/lib/boresight", str(tmp_path)),
        (". /etc/boresight/night.env;", ""),
    ):
        command = command.replace(old, new)
    done = subprocess.run(["/bin/sh", "-c", command], capture_output=True, text=True, check=False)
    assert bool(done.stdout) == (code != 0)
    assert options_of(fake_night)["--held-exit-code"] == "0"
    assert known(options_of(fake_night))


def test_the_settings_are_all_that_the_commands_ask_for():
    given = {x.partition("=")[0] for x in (SYSTEMD / "night.env").read_text().splitlines() if "=" in x}
    files = [*SYSTEMD.glob("*.service"), SYSTEMD / "crontab"]
    asked = {name for f in files for name in re.findall(r'"\$(BORESIGHT\w*)"', f.read_text())}
    assert given == asked


# Kubernetes


def manifest(path):
    return YAML(typ="safe").load(path.read_text())


@pytest.fixture(scope="module")
def kubernetes():
    """Kubernetes' own schema, as a function that takes manifests or raises."""
    python = os.environ.get("BORESIGHT_READERS")
    if not python:
        pytest.skip("BORESIGHT_READERS names no Python with kubernetes-validate: make readers")

    def takes(*told):
        code = "import json, sys, kubernetes_validate as k\nfor one in json.load(sys.stdin):"
        code += " k.validate(one, k.latest_version(), strict=True)"
        sent = json.dumps(told)
        done = subprocess.run([python, "-c", code], input=sent, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-3000:]

    with pytest.raises(AssertionError, match="On instance"):  # it looks
        takes({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "a"}, "spec": {"container": []}})
    return takes


def test_kubernetes_own_schema_takes_the_cronjob_and_the_pods_of_the_rayjob(kubernetes):
    kubernetes(manifest(CRONJOB))
    kubernetes(*({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "a"}, "spec": p} for p in pods()))


def test_a_cronjob_tries_again_what_may_help_and_a_held_day_is_no_failed_pod():
    spec = manifest(CRONJOB)["spec"]
    job = spec["jobTemplate"]["spec"]
    pod = job["template"]["spec"]
    [night] = pod["containers"]
    rules = {rule["action"]: rule for rule in job["podFailurePolicy"]["rules"]}
    codes = {"containerName": night["name"], "operator": "In", "values": [2]}
    assert rules["FailJob"]["onExitCodes"] == codes
    assert "DisruptionTarget" in str(rules["Ignore"])
    assert "--held-exit-code=0" in night["args"]
    assert "command" not in night  # the image's own: no shell stands between SIGTERM and the night
    assert (spec["concurrencyPolicy"], pod["restartPolicy"]) == ("Forbid", "Never")
    assert pod["terminationGracePeriodSeconds"] > 10
    assert known(night["args"])
    assert pod["securityContext"]["runAsUser"] == 10001  # as in the Dockerfile
    assert "--uid 10001" in (DEPLOY / "Dockerfile").read_text()


def test_every_volume_is_mounted_and_every_mount_is_a_volume():
    for pod in pods():
        volumes = {v["name"] for v in pod["volumes"]}
        assert {m["name"] for c in pod["containers"] for m in c["volumeMounts"]} == volumes


def pods():
    ray = manifest(RAYJOB)["spec"]["rayClusterSpec"]
    groups = [ray["headGroupSpec"], *ray["workerGroupSpecs"]]
    return [
        manifest(CRONJOB)["spec"]["jobTemplate"]["spec"]["template"]["spec"],
        *(g["template"]["spec"] for g in groups),
    ]


def test_a_rayjob_runs_the_night_with_the_ray_that_was_tested():
    spec = manifest(RAYJOB)["spec"]
    cluster = spec["rayClusterSpec"]
    assert spec["ttlSecondsAfterFinished"] == 0 or spec["shutdownAfterJobFinishes"]
    arguments = spec["entrypoint"].split()
    assert arguments[:4] == ["boresight", "nightly", "--executor", "ray"]
    assert known(arguments)
    assert "--held-exit-code 0" in spec["entrypoint"]
    assert f"ray=={cluster['rayVersion']}\n" in (REPO / "constraints.txt").read_text()
    assert f"rayproject/ray:{cluster['rayVersion']}-py311" in (DEPLOY / "Dockerfile.ray").read_text()
    assert cluster["headGroupSpec"]["rayStartParams"]["num-cpus"] == "0"
    # Where logs, lake and configuration are must be the same for the driver and the workers.
    mounts = [c["volumeMounts"] for pod in pods()[1:] for c in pod["containers"]]
    assert all(m == mounts[0] for m in mounts)


def test_the_readme_names_every_file_and_images_install_what_this_release_is():
    readme = (DEPLOY / "README.md").read_text()
    files = [p.relative_to(DEPLOY) for p in DEPLOY.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    assert [str(f) for f in files if f.name not in readme and f.name != "README.md"] == []
    version = tomllib.loads((REPO / "pyproject.toml").read_text())["project"]["requires-python"]
    assert version == ">=3.11"
    assert all("python:3.11-slim" in (DEPLOY / f).read_text() for f in ("Dockerfile", "Dockerfile.ray"))
