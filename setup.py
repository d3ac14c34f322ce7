"""Build settings for the wheel of `warp_lcp`.

`fluids`, `granular` and `benchmarks` in it are symbolic links to the folders beside it. Git on
Windows writes such a link as a text file; then the packages are taken from these folders.
"""

from pathlib import Path

from setuptools import find_namespace_packages, setup

LINKED = ["fluids", "granular", "benchmarks"]
RESULTS = "benchmarks.results*"

unlinked = [name for name in LINKED if not Path("warp_lcp", name).is_dir()]
beside = find_namespace_packages(
    include=[pattern for name in unlinked for pattern in (name, f"{name}.*")], exclude=[RESULTS]
)
setup(
    packages=[
        *find_namespace_packages(
            include=["warp_lcp", "warp_lcp.*"], exclude=[f"warp_lcp.{RESULTS}"]
        ),
        *(f"warp_lcp.{name}" for name in beside),
    ],
    package_dir={f"warp_lcp.{name}": name for name in unlinked},
)
