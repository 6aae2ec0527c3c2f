"""What the engine for Ray makes of deaths, defects and clusters that do not answer, on a stand-in for Ray."""

import sys
from pathlib import Path

import pytest
from fixtures.ray_stand_in import DEATH, Ray, RayTaskError

from cadence.errors import DeviceError
from pipeline.batch.engines.ray import NUM_ATTEMPTS, run_on_ray
from pipeline.batch.tasks import LogOutcome, LogTask, RunConfig

CONFIG = RunConfig()


@pytest.fixture
def ray(monkeypatch):
    """Puts a stand-in in the place of Ray."""

    def installed(**options):
        stand_in = Ray(**options)
        monkeypatch.setitem(sys.modules, "ray", stand_in)
        monkeypatch.setitem(sys.modules, "ray.exceptions", stand_in.exceptions)
        monkeypatch.delenv("RAY_ADDRESS", raising=False)
        return stand_in

    return installed


def tasks_in(out: Path, num_tasks: int = 4) -> list[LogTask]:
    return [LogTask(i, (f"log{i}.mcap",), str(out / f"log{i}"), 0, CONFIG) for i in range(num_tasks)]


def succeed(task, progress):
    progress.note(f"{task.name} begins")
    return LogOutcome(task, elapsed_s=1.0)


def ignore(task, told):
    pass


def test_workers_are_used_again_and_end_with_the_batch(ray, tmp_path):
    cluster, heard = ray(), []
    outcomes = list(run_on_ray(tasks_in(tmp_path), succeed, lambda task, told: heard.append((task.name, told))))
    assert sorted(outcome.task.name for outcome in outcomes) == ["log0", "log1", "log2", "log3"]
    assert all(outcome.elapsed_s == 1.0 for outcome in outcomes)
    assert sorted(heard) == [(f"log{i}", f"log{i} begins") for i in range(4)]
    assert cluster.num_started == cluster.num_cpus == 2 and cluster.alive == []
    assert not cluster.is_connected and not list(tmp_path.iterdir())  # no token is left


def test_never_more_workers_than_asked_for_or_than_tasks(ray, tmp_path):
    cluster = ray(num_cpus=8)
    assert len(list(run_on_ray(tasks_in(tmp_path), succeed, ignore, num_workers=1))) == 4
    assert cluster.num_started == 1 and cluster.options_of_init["num_cpus"] == 1
    cluster = ray(num_cpus=8)
    list(run_on_ray(tasks_in(tmp_path, 3), succeed, ignore))
    assert cluster.num_started == 3


@pytest.mark.parametrize("num_deaths", [1, NUM_ATTEMPTS - 1, NUM_ATTEMPTS])
def test_a_task_is_tried_again_until_it_has_cost_too_many_workers(ray, tmp_path, num_deaths):
    cluster, heard, tries = ray(), [], []

    def run(task, progress):
        tries.append(task.name)
        if task.name == "log1" and tries.count("log1") <= num_deaths:
            progress.note(DEATH)
        return LogOutcome(task)

    found = {o.task.name: o for o in run_on_ray(tasks_in(tmp_path), run, lambda task, told: heard.append(told))}
    assert len(found) == 4 and all(found[f"log{i}"].exit_code == 0 for i in (0, 2, 3))
    again = f"worker died (ActorDiedError: {DEATH}); started again by another"
    assert heard == [again] * min(num_deaths, NUM_ATTEMPTS - 1)
    is_given_up = num_deaths == NUM_ATTEMPTS
    assert found["log1"].exit_code == (DeviceError.exit_code if is_given_up else 0)
    assert (f"log1.mcap: {NUM_ATTEMPTS} workers died of it" in found["log1"].message) == is_given_up
    assert tries.count("log1") == min(num_deaths + 1, NUM_ATTEMPTS) and cluster.alive == []


def test_a_defect_is_no_death(ray, tmp_path):
    cluster = ray()

    def run(task, progress):
        raise ZeroDivisionError("a defect")

    with pytest.raises(RayTaskError, match="a defect"):
        list(run_on_ray(tasks_in(tmp_path), run, ignore))
    assert cluster.alive == [] and not cluster.is_connected


def test_workers_that_cannot_start(ray, tmp_path):
    ray(start_failure="The actor died because of an error raised in its creation task.\nModuleNotFoundError: no cadence")
    with pytest.raises(DeviceError, match=r"workers cannot start \(ActorDiedError: ModuleNotFoundError: no cadence\); install"):
        list(run_on_ray(tasks_in(tmp_path), succeed, ignore))


def test_folders_that_workers_do_not_see(ray, tmp_path, monkeypatch):
    ray()
    monkeypatch.setattr(Path, "touch", lambda path: None)
    with pytest.raises(DeviceError, match=r"does not see it; put it on storage that all share") as failure:
        list(run_on_ray(tasks_in(tmp_path), succeed, ignore))
    assert str(tmp_path) in str(failure.value)


def test_folders_that_cannot_be_written(ray, tmp_path):
    ray()
    (tmp_path / "file").touch()
    with pytest.raises(DeviceError, match=r"file: cannot write there \(.+\); choose another folder with --out"):
        list(run_on_ray(tasks_in(tmp_path / "file"), succeed, ignore))


@pytest.mark.parametrize(("address", "where"), [(None, "--engine ray"), ("10.0.0.1:6379", "RAY_ADDRESS=10.0.0.1:6379")])
def test_a_cluster_that_does_not_answer(ray, tmp_path, monkeypatch, address, where):
    ray(init_failure=ConnectionError("nobody\nis there"))
    if address:
        monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(DeviceError, match=f"^{where}: no Ray can be reached or started .ConnectionError: is there.; see"):
        list(run_on_ray(tasks_in(tmp_path), succeed, ignore))


def test_results_in_buckets_need_no_folder_that_all_see(ray, monkeypatch):
    ray()
    monkeypatch.setattr(Path, "touch", lambda path: pytest.fail(f"{path} was written"))
    tasks = [LogTask(0, ("s3://bucket/log.mcap",), "s3://bucket/out/log", 0, CONFIG)]
    assert len(list(run_on_ray(tasks, succeed, ignore))) == 1


def test_a_connection_that_was_there_before_stays(ray, tmp_path):
    cluster = ray()
    cluster.init()
    list(run_on_ray(tasks_in(tmp_path), succeed, ignore))
    assert cluster.is_connected


def test_stopping_early_ends_the_workers(ray, tmp_path):
    cluster = ray()
    outcomes = run_on_ray(tasks_in(tmp_path), succeed, ignore)
    next(outcomes)
    assert cluster.alive
    outcomes.close()
    assert cluster.alive == [] and not list(tmp_path.iterdir())
