from tests.benchmarks.environment_sizes import measure_environment, measure_installed_night


def test_what_lies_in_an_environment_is_counted_once_by_package_and_compiled_python_not_at_all(tmp_path):
    packages = tmp_path / "lib" / "python3.11" / "site-packages"
    for name, size in (
        ("a/x.py", 1_000_000),
        ("a.libs/l.so", 2_000_000),
        ("a/x.pyc", 9_000_000),
        ("b.py", 500_000),
    ):
        path = packages / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes(size))
    (tmp_path / "lib64").symlink_to("lib")
    assert measure_environment(tmp_path) == {
        "megabytes": 3.5,
        "files": 3,
        "largest_megabytes": {"a": 3.0, "b.py": 0.5},
    }


def test_what_the_night_needs_of_this_environment_is_its_dependencies_and_no_extra():
    found = measure_installed_night()
    assert {"pyarrow", "deltalake", "scipy"} <= set(found["largest_megabytes"])
    assert not {"torch", "ray", "av"} & set(found["largest_megabytes"])
    assert 500 < found["megabytes"] < 1500
