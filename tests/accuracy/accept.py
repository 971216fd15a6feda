"""The baseline, measured under the type checks that the tests run under: they cost a third of a calibration's CPU.

python -m tests.accuracy.accept --accept    (make accuracy-accept; options as of tests.accuracy.baseline)
"""

from jaxtyping import install_import_hook

install_import_hook(["schemas", "pipeline"], "beartype.beartype")

from tests.accuracy import baseline  # noqa: E402 - what is imported from here on is checked

if __name__ == "__main__":
    baseline.main()
