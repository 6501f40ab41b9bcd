"""The C library measures as Python does, bit for bit, and refuses what it cannot trust."""

import ctypes
import os
import platform
import shutil
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.adapters.library_cases import (
    CACHE,
    EXAMPLES,
    assert_same_bits,
    copied,
    exported,
    frames_of,
    irregular_layout,
    measure_example,
    pipeline_of,
    python,
    run,
    sensor_of,
)
from tests.estimator_cases import one_psf

import faintspot as fs
from faintspot.adapters.library import folder as folder_module
from faintspot.adapters.library.bundle import Variant, bundle_of
from faintspot.adapters.library.folder import ExportedLibrary, export_library
from faintspot.adapters.library.objects import TARGETS, fingerprint, native_target, object_file
from faintspot.base.errors import InputError
from faintspot.slopes.estimators import estimators

RUNTIME = Path(fs.__file__).parent / "adapters" / "library" / "runtime"
needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


class TestBundle:
    def test_what_only_python_measures_is_refused(self, tmp_path: Path) -> None:
        layout = irregular_layout()
        psf, camera = one_psf(), fs.Calibration(dark=0.0, read_noise_e=1.0)
        flux = fs.SlopePipeline(layout, fs.Settings("map", search_range_px=2.0), camera, psf=psf)
        binned = fs.SlopePipeline(fs.Layout.grid((2, 2), pixels=8, bin=2), fs.Settings("centroid"))
        for pipeline in (flux, binned):
            with pytest.raises(InputError):
                export_library(pipeline, tmp_path)
        with pytest.raises(InputError):
            export_library(pipeline_of("centroid"), tmp_path, cpus=["z80"])
        assert not list(tmp_path.rglob("*.o"))

    def test_fingerprints_differ_with_width_and_processor_alone(self) -> None:
        calls = [Variant.of(pipeline_of("centroid"), "uint16", width).measure for width in (4, 8)]
        keys = {fingerprint(call.kernel, call.kinds, cpu) for call in calls for cpu in TARGETS}
        assert len(keys) == 2 * len(TARGETS)
        same = Variant.of(pipeline_of("brightest"), "images", 8).measure
        assert fingerprint(same.kernel, same.kinds, "x86-64") in keys


@pytest.fixture(scope="module")
def without_kernels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runtime, built without any kernel."""
    folder = tmp_path_factory.mktemp("runtime")
    shutil.copytree(RUNTIME, folder, dirs_exist_ok=True)
    (folder / "kernels").mkdir()
    (folder / "kernels" / "list.h").write_text("KERNEL(0, 9)\n")
    stub = "#include <stdint.h>\nint faintspot_kernel_0(int64_t *cells) { return cells == 0; }\n"
    (folder / "none.c").write_text(stub)
    flags = "-O1 -Wall -Wextra -Werror -fPIC -shared -fvisibility=hidden"
    run("cc", *flags.split(), "-o", "lib.so", "faintspot.c", "none.c", cwd=folder)
    return folder


@pytest.mark.slow
@needs_compiler
class TestRuntime:
    def test_header_is_c_and_cpp(self) -> None:
        for compiler, standard in (("cc", "c11"), ("c++", "c++11")):
            if shutil.which(compiler):
                language = "c++" if compiler == "c++" else "c"
                flags = ["-fsyntax-only", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-std={standard}"]
                run(compiler, *flags, "-x", language, RUNTIME / "faintspot.h")

    def test_bundles_that_cannot_be_used(self, without_kernels: Path) -> None:
        good = bundle_of([(Variant.of(pipeline_of("centroid"), "uint16", 8), "0a", "0b")], b"")
        rng = np.random.default_rng(1)
        damaged = [b"", good[:10], good[:-1], good + b"\0", b"x" * 1000]
        for _ in range(100):
            copy = bytearray(good)
            copy[rng.integers(len(copy))] ^= 1 << rng.integers(8)
            damaged.append(bytes(copy))
        reasons = set()
        for content in (*damaged, good):
            with pytest.raises(ValueError) as error:  # noqa: PT011
                measure_example().Sensor(str(without_kernels / "lib.so"), content)
            reasons.add(str(error.value))
        assert len(reasons) >= 5  # cut short, damaged, foreign, another format, no kernels: each says which
        with pytest.raises(ValueError) as error:  # noqa: PT011
            measure_example().Sensor(str(without_kernels / "lib.so"), good, "float32")
        assert str(error.value) not in reasons


PARAMETERS = ["tv", "brightest", "thresholded", "window", "ml"]
# A centroid has no step that thresholded ones lack.
ALL = [(name, False) for name in estimators() if name != "centroid"] + [("brightest", True)]


@pytest.mark.slow
@needs_compiler
class TestBits:
    @pytest.mark.parametrize(("estimator", "noise_map"), ALL)
    def test_frames_whole_and_by_groups(self, estimator: str, noise_map: bool) -> None:
        pipeline = pipeline_of(estimator, TARGETS[native_target()].width, noise_map=noise_map)
        library = exported(pipeline, f"{estimator}_{noise_map}")
        for kind in ("uint16", "float32"):
            sensor, frames = sensor_of(library, kind), frames_of(pipeline, kind)
            groups = sensor.sensor.groups
            for frame in frames:
                expected = pipeline(frame)
                assert_same_bits(sensor.measure(frame), expected)
                for group in np.random.default_rng(1).permutation(groups).tolist():
                    rows = sensor.call("rows", group)
                    arrived = frame.copy()
                    arrived[rows:] = 7  # not there yet
                    assert sensor.call("measure", 0, arrived, group, group + 1) == 0
                sensor.call("finish", 0, frame)
                assert_same_bits(sensor.slopes, expected)
            sensor.close()


REFERENCE = """
import sys
import numpy as np
from tests.adapters.library_cases import frames_of, pipeline_of
from faintspot.slopes.kernels.groups import SlopeArrays
pipeline = pipeline_of("brightest")
slopes = pipeline(frames_of(pipeline, "uint16"))
np.savez(sys.argv[1], width=pipeline.width, **{name: getattr(slopes, name) for name in SlopeArrays._fields})
"""


@pytest.mark.slow
@needs_compiler
class TestTargets:
    def test_plain_code_has_the_bits_of_python_on_a_plain_processor(self, tmp_path: Path) -> None:
        pipeline, cpu = pipeline_of("brightest"), "x86-64"
        environment = {
            **os.environ,
            "NUMBA_CPU_NAME": cpu,
            "NUMBA_CPU_FEATURES": TARGETS[cpu].features,
            "NUMBA_CACHE_DIR": str(CACHE / "plain"),
            "PYTHONPATH": os.pathsep.join(sys.path),
        }
        run(python(), "-c", REFERENCE, tmp_path / "slopes.npz", env=environment)
        library = exported(pipeline, "plain", CACHE / cpu, cpus=[cpu])
        sensor = sensor_of(library, "uint16")
        assert sensor.sensor.width == 4
        with np.load(tmp_path / "slopes.npz") as stored:
            expected = {name: stored[name] for name in stored}
        assert expected.pop("width") == 4
        frames = frames_of(pipeline, "uint16")
        usual = pipeline(frames)
        valid = usual.valid & (expected["flags"] == usual.flags)
        assert np.mean(valid) > 0.7
        for name in ("x", "y"):  # float32 rounding (6e-8) over 10 px, summed over 90 pixels
            np.testing.assert_allclose(expected[name][valid], getattr(usual, name)[valid], atol=2e-5)
        for index, frame in enumerate(frames):
            for name, values in sensor.measure(frame).items():
                assert values.tobytes() == expected[name][index].tobytes(), name

    def test_code_for_better_processors_does_not_run(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        if native_target() == "x86-64-v4":
            pytest.skip("this processor has AVX-512")

        def stub(kernel: Any, kinds: Any, cpu: str, name: str) -> bytes:
            if cpu == native_target():
                return object_file(kernel, kinds, cpu, name)
            (tmp_path / "stub.c").write_text(f"int {name}(long *cells) {{ return cells == 0; }}\n")
            run("cc", "-c", "-fPIC", "stub.c", cwd=tmp_path)
            return (tmp_path / "stub.o").read_bytes()

        monkeypatch.setattr(folder_module, "object_file", stub)
        library = exported(pipeline_of("brightest"), "better", tmp_path, cpus=["x86-64-v4"])
        with pytest.raises(ValueError):  # noqa: PT011
            sensor_of(library, "uint16")
        (CACHE / "kernels").mkdir(parents=True, exist_ok=True)  # with what others compiled for this processor
        shutil.copytree(CACHE / "kernels", tmp_path / "kernels", dirs_exist_ok=True)
        both = exported(pipeline_of("brightest"), "both", tmp_path, cpus=["x86-64-v4", native_target()])
        assert sensor_of(both, "uint16").sensor.processor.decode() == native_target()

    def test_objects_for_aarch64(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        call = Variant.of(pipeline_of("brightest"), "uint16", TARGETS["aarch64"].width).measure
        kept = CACHE / f"{fingerprint(call.kernel, call.kinds, 'aarch64')}.o"
        if not kept.exists():
            kept.write_bytes(object_file(call.kernel, call.kinds, "aarch64", "faintspot_kernel"))
        content = kept.read_bytes()
        assert content[18:20] == b"\xb7\x00"  # ELF's number of AArch64
        monkeypatch.setattr(folder_module, "object_file", lambda *_: content)
        library = exported(pipeline_of("brightest"), "arm", tmp_path, cpus=["aarch64"])
        assert (library.library is None) == (platform.machine() != "aarch64")
        with pytest.raises(InputError):
            export_library(pipeline_of("brightest"), tmp_path, cpus=["x86-64"])


def brightest(name: str) -> tuple[fs.SlopePipeline, ExportedLibrary]:
    """The sensor whose kernel compiles fastest, and its library."""
    pipeline = pipeline_of("brightest", TARGETS[native_target()].width)
    return pipeline, exported(pipeline, name)


@pytest.mark.slow
@needs_compiler
class TestUse:
    def test_threads_measure_a_frame_together(self) -> None:
        pipeline, library = brightest("threads")
        sensor, frames = sensor_of(library, "uint16", threads=3), frames_of(pipeline, "uint16")
        groups = sensor.sensor.groups
        for frame in frames:
            bounds = [groups * share // 3 for share in range(4)]
            threads = [
                threading.Thread(target=sensor.call, args=("measure", k, frame, bounds[k], bounds[k + 1]))
                for k in range(3)
            ]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            sensor.call("finish", 2, frame)
            assert_same_bits(sensor.slopes, pipeline(frame))

    @pytest.mark.parametrize("estimator", PARAMETERS)
    def test_parameters_are_those_of_python(self, estimator: str) -> None:
        pipeline = pipeline_of(estimator, TARGETS[native_target()].width)
        sensor = sensor_of(exported(pipeline, estimator), "uint16")
        rng, n = np.random.default_rng(6), len(pipeline.layout)
        values = {
            "noise_std": rng.uniform(0, 5, n),
            "tolerance": rng.choice([0.0, 0.0025, 0.01], n),
            "max_iterations": rng.integers(1, 60, n).astype(float),
            "threshold_e": rng.uniform(0, 20, n),
            "flux_floor": rng.uniform(0, 0.2, n),
            "search_range_px": rng.uniform(0.5, 4.0, n),
            "model_error": rng.choice([0.0, 0.2], n),
        }
        names = {
            sensor.call("parameter", k).decode() for k in range(len(pipeline.plan.prepared.rows_of_options))
        }
        assert names == set(pipeline.plan.prepared.rows_of_options)
        assert names <= set(values)
        for name in names:
            before = copied(sensor.measure(frames_of(pipeline, "uint16")[0]))
            wrong = values[name].astype(np.float32)
            for value in (np.nan, -1.0):
                wrong[3] = value
                assert sensor.call("set", name.encode(), wrong) == -1
            after = sensor.measure(frames_of(pipeline, "uint16")[0])
            assert all(np.array_equal(before[key], after[key]) for key in after)  # nothing changed
            assert sensor.call("set", name.encode(), values[name].astype(np.float32)) == 0
        options = {name: values[name].astype(int) if "max" in name else values[name] for name in names}
        changed = pipeline.with_settings(pipeline.settings.replace(**options))
        for frame in frames_of(pipeline, "uint16"):
            assert_same_bits(sensor.measure(frame), changed(frame))
        assert sensor.call("set", b"prior_std_px", wrong) == -1
        assert sensor.call("prior", None, None, None) == -1

    def test_prior_of_map(self) -> None:
        pipeline = pipeline_of("map", TARGETS[native_target()].width)
        sensor = sensor_of(exported(pipeline, "map_False"), "uint16")
        rng, n = np.random.default_rng(7), len(pipeline.layout)
        std = rng.uniform(0.1, 1.0, n).astype(np.float32)
        wider = pipeline.with_settings(pipeline.settings.replace(prior_std_px=std))
        for frame in frames_of(pipeline, "uint16", 12):
            prior = rng.normal(0, 1, (2, n)).astype(np.float32)
            prior[0, 3], prior[1, 4] = np.nan, 1e6  # not predicted
            assert sensor.call("prior", prior[0], prior[1], std) == 0
            assert_same_bits(sensor.measure(frame), wider(frame, prior.ravel()))
        assert sensor.call("prior", None, None, std * 0) == -1
        sensor.call("prior", None, None, None)
        assert_same_bits(sensor.measure(frame), wider(frame))

    def test_dark_subapertures(self) -> None:
        pipeline, library = brightest("dark")
        sensor, frame = sensor_of(library, "uint16"), frames_of(pipeline, "uint16")[0]
        dark = np.arange(len(pipeline.layout)) % 3 == 0
        for _ in range(2):
            sensor.call("dark", dark.astype(np.uint8))
            slopes = sensor.measure(frame)
            assert np.all(slopes["x"][dark] == 0)
            assert np.all(slopes["flags"][dark] & fs.SubapertureFlag.NO_FLUX)
        sensor.call("dark", np.zeros(len(dark), np.uint8))
        assert_same_bits(sensor.measure(frame), pipeline(frame))

    def test_images_one_by_one(self) -> None:
        pipeline, library = brightest("images")
        sensor = sensor_of(library, "images")
        images = pipeline.explain(frames_of(pipeline, "uint16")[0]).calibrated
        n, ny, nx = images.shape
        stacked = pipeline.for_images()
        expected = stacked(images.reshape(n * ny, nx))
        assert_same_bits(sensor.measure(images), expected)
        apart = np.full((n, ny * nx + 5), np.nan, np.float32)
        apart[:, : ny * nx] = images.reshape(n, -1)
        other = sensor_of(library, "images")
        stride = ctypes.c_size_t(apart.shape[1])
        for first, count in ((0, 1), (1, 9), (10, n - 10)):
            part = apart[first : first + count].copy()
            assert other.call("images", 0, part, stride, first, count) == 0
        for name in ("x", "y", "flux", "iterations", "standard_error_x", "covariance_xy"):
            # The test for dark windows needs whole frames.
            lit = expected.flags & fs.SubapertureFlag.NO_FLUX == 0
            np.testing.assert_array_equal(other.slopes[name][lit], getattr(expected, name)[lit])
        for wrong in ((0, n + 1), (-1, 1), (n, 1)):
            assert other.call("images", 0, apart, stride, *wrong) == -1


@pytest.mark.slow
@needs_compiler
class TestMemory:
    LINK = ("-Wl,--wrap=malloc,--wrap=calloc,--wrap=aligned_alloc", "-lm")

    def built(self, folder: Path, library: ExportedLibrary, *flags: str) -> Path:
        """The harness with the runtime and the kernels in it."""
        source, objects = library.bundle.parent, sorted((library.bundle.parent / "kernels").glob("*.o"))
        harness = Path(__file__).parent / "library_harness.c"
        compiler = ["cc", "-g", "-O1", "-Wall", *flags, f"-I{source}", "-o", folder / "harness"]
        run(*compiler, harness, source / "faintspot.c", *objects, *self.LINK)
        return folder / "harness"

    def test_sanitizers_and_allocations(self, tmp_path: Path) -> None:
        pipeline, library = brightest("memory")
        program = self.built(tmp_path, library, "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
        limits = {"ASAN_OPTIONS": "allocator_may_return_null=1"}  # for sizes that damage makes up
        images = pipeline.explain(frames_of(pipeline, "float32")[:10]).calibrated
        for kind in ("uint16", "float32", "images"):
            (images if kind == "images" else frames_of(pipeline, kind)).tofile(tmp_path / "frames")
            number = measure_example().PIXELS[kind]
            out = run(program, library.bundle, number, tmp_path / "frames", 600, env=limits).stdout
            assert "allocations in frames: 0\n" in out

    @pytest.mark.skipif(shutil.which("valgrind") is None, reason="no valgrind")
    def test_valgrind(self, tmp_path: Path) -> None:
        pipeline, library = brightest("memory")
        frames_of(pipeline, "uint16")[-9:].tofile(tmp_path / "frames")
        check = ("valgrind", "-q", "--error-exitcode=9", "--leak-check=full")
        run(*check, self.built(tmp_path, library), library.bundle, 0, tmp_path / "frames", 60)

    @pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
    def test_nothing_but_libc_is_needed(self) -> None:
        _, library = brightest("threads")
        symbols = run("nm", "-D", "-u", library.library).stdout.split()
        needed = {name.partition("@")[0] for name in symbols if "@" in name} - {"__cxa_finalize"}
        files = {"fclose", "fopen", "fread", "fseek", "ftell"}
        memory = {"aligned_alloc", "calloc", "free", "malloc"}
        # `exp` is that of libm, for "map".
        assert needed <= files | memory | {"exp", "memcpy", "memset", "strcmp"}


@pytest.mark.slow
@needs_compiler
class TestExamples:
    def test_c_and_python(self, tmp_path: Path) -> None:
        pipeline, library = brightest("example")
        folder, frames = library.bundle.parent, frames_of(pipeline, "uint16", 9)
        frames.tofile(tmp_path / "frames.raw")
        np.save(tmp_path / "frame.npy", frames[0])
        flags = ("-Wall", "-Wextra", "-Werror", f"-I{folder}", f"-L{folder}")
        link = (*flags, "-lfaintspot", f"-Wl,-rpath,{folder}")
        run("cc", EXAMPLES / "measure.c", "-o", tmp_path / "c", *link)
        run(tmp_path / "c", library.bundle, tmp_path / "frames.raw", tmp_path / "slopes.raw")
        expected = pipeline(frames)
        found = np.fromfile(tmp_path / "slopes.raw", np.float32).reshape(9, 2, -1)
        np.testing.assert_array_equal(found, np.stack([expected.x, expected.y], axis=1))
        text = run(python(), EXAMPLES / "measure.py", library.library, library.bundle, tmp_path / "frame.npy")
        assert f"{float(expected.x[0, 0]):.6f} px" in text.stdout
