"""Damaged cached kernels are recompiled; an unusable folder is named."""

import os
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import warp as wp

from warp_lcp.run.kernel_cache import KernelCacheError, mend, watch_loads


@wp.kernel(module="unique")
def increase(x: wp.array(dtype=float)):
    x[wp.tid()] += 1.0


def write(file: Path, data: bytes) -> None:
    if file.is_dir():
        file.rmdir()
    file.write_bytes(data)


def replace_by_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def cut(share: float) -> Callable[[Path], None]:
    return lambda file: write(file, file.read_bytes()[: int(share * file.stat().st_size)])


DAMAGES: dict[str, Callable[[Path], None]] = {
    "empty": cut(0.0),
    "a byte": lambda file: write(file, file.read_bytes()[:1]),
    "the start": cut(0.01),
    "half": cut(0.5),
    "all but a byte": lambda file: write(file, file.read_bytes()[:-1].rstrip(b"\0}\n ")),
    "zeros": lambda file: write(file, bytes(file.stat().st_size)),
    "its end is zeros": lambda file: write(
        file, file.read_bytes()[: file.stat().st_size // 2] + bytes(file.stat().st_size // 2)
    ),
    "garbage": lambda file: write(file, random.Random(6_211).randbytes(4000)),
    "a folder": replace_by_folder,
}


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Return a cache with a module, its folder, and a function that launches a kernel.

    It launches as a new process would.
    """
    before, cache = wp.config.kernel_cache_dir, tmp_path_factory.mktemp("cache")
    load = wp.Module.load
    watch_loads()
    wp.config.kernel_cache_dir = str(cache)

    def launch() -> float:
        increase.module.unload()
        x = wp.zeros(3, device="cpu")
        wp.launch(increase, dim=3, inputs=[x], device="cpu")
        return float(x.numpy().sum())

    assert launch() == 3.0
    (folder,) = cache.glob("wp_*")
    yield folder, launch
    wp.config.kernel_cache_dir, wp.Module.load = before, load
    increase.module.unload()


@pytest.mark.every_case
@pytest.mark.parametrize("suffix", [".o", ".meta", ".cpp"])
@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_compiled_again(compiled, damage, suffix):
    folder, launch = compiled
    (file,) = folder.glob(f"*{suffix}")
    whole = file.read_bytes()
    DAMAGES[damage](file)
    assert launch() == 3.0
    if suffix == ".cpp":  # it is never read
        write(file, whole)
    assert file.is_file()
    assert not mend(folder)


def test_a_file_in_place_of_the_folder(compiled):
    folder, launch = compiled
    folder.rename(folder.with_name("away"))
    folder.write_text("")
    assert launch() == 3.0
    assert folder.is_dir()


def test_whole_modules_are_left_alone(compiled):
    folder, launch = compiled
    before = {file.name: file.stat().st_mtime_ns for file in folder.iterdir()}
    assert launch() == 3.0
    assert {file.name: file.stat().st_mtime_ns for file in folder.iterdir()} == before
    assert not mend(folder.with_name("none"))
    load = wp.Module.load
    watch_loads()
    assert wp.Module.load is load  # it is already wrapped


def test_a_cache_that_cannot_be_written(compiled, tmp_path):
    _, launch = compiled
    before = wp.config.kernel_cache_dir
    (tmp_path / "file").write_text("")
    wp.config.kernel_cache_dir = str(tmp_path / "file" / "cache")
    try:
        with pytest.raises(
            KernelCacheError,
            match=r"the folder of compiled kernels .* cannot be used .*WARP_CACHE_PATH",
        ):
            launch()
    finally:
        wp.config.kernel_cache_dir = before
    assert launch() == 3.0


@pytest.mark.slow
def test_a_cache_that_cannot_be_made(tmp_path):
    (tmp_path / "file").write_text("")
    command = [sys.executable, "-c", "from warp_lcp.cli.commands import main; main()", "info"]
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "file")}
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 1
    assert "Traceback" not in result.stderr
    assert result.stderr.count(f"{tmp_path / 'file'}") == 1
    assert "have WARP_CACHE_PATH name another one" in result.stderr
