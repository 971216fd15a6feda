"""The study of executors: what other processes take of the machine does not count against a night."""

from tests.benchmarks.studies.executor_efficiency import table


def night(executor, wall_s, own_cpu_s, others_cpu_s=0.0):
    left_s = 2 * wall_s - others_cpu_s
    return {"executor": executor, "own_cpu_s": own_cpu_s, "left_s": left_s}


def test_a_pool_that_uses_all_that_is_left_to_it_is_efficient_beside_others():
    lines = [night("inline", 100, 90), night("process", 50, 95), night("ray", 60, 100)]
    busy = [night("inline", 130, 90, 120), night("process", 80, 95, 60), night("ray", 90, 100, 60)]
    quiet = (
        "process: efficiency 0.90 (1 nights)\nray: efficiency 0.75 (1 nights)\nray against process: 0.83\n"
    )
    assert table(lines) == table(busy) == quiet
