from __future__ import annotations

import io
import struct
import zipfile

import pytest
from helpers import INSTRUMENTS, assert_holds, refusal
from test_csv import assert_same

from mcc_jax._errors import InputError
from mcc_jax.campaign import read_campaign, read_diameters, read_instrument_file, write_campaign
from mcc_jax.campaign.readers import micromaterials

FILES = FS, HLD, LC, ZIP = ("FS1.txt", "Exp-50mN_0000.hld", "RobinSteel0000LC.txt", "multipleIndentations.zip")
SIZES = [200.0, 190.0, 180.0]


def read(path, **kwargs):
    return read_instrument_file(path, **{"diameters_um": SIZES} | kwargs)


def message(path, **kwargs) -> str:
    return refusal(read, path, **kwargs)


def test_fischer():
    campaign = read(INSTRUMENTS / FS)
    assert campaign.particles == tuple(str(i) for i in range(1, 11))
    assert campaign.diameters_um.shape == (10, 3)
    assert campaign.metadata.control == "load"
    first = campaign.curves[0]
    # The first and the last row of the first test, as they stand in the file.
    assert (first.force_mN[0], first.displacement_um[0], first.time_s[0]) == (0.416459, 0.031365, 0.1)
    assert (first.force_mN[-1], first.displacement_um[-1], first.time_s[-1]) == (29.9928, 0.89375, 120.0)
    assert [len(curve) for curve in campaign.curves] == [1200] * 10
    for curve in campaign.curves:
        assert curve.force_mN.max() == pytest.approx(300, abs=0.01)
    assert "R = 10% 8 Cycles" in campaign.metadata.other["test_parameters"]
    assert "Compliance\t[µm/N]\t      1.9" in campaign.metadata.other["instrument_results"]["1"]


def test_hysitron_hld():
    campaign = read(INSTRUMENTS / HLD)
    assert campaign.particles == ("Exp-50mN_0000",)
    curve, other = campaign.curves[0], campaign.metadata.other
    assert len(curve) == 1068
    assert curve.displacement_um[0] == 5.800346 / 1e3
    assert curve.force_mN[0] == 204.644060 / 1e3
    assert curve.force_mN.max() == pytest.approx(50, rel=0.01)
    assert campaign.metadata.control == "load"
    assert other["machine_compliance_um_per_mN"] == 0.00663947
    assert other["drift_rate_um_per_s"] == pytest.approx(3.648e-5)
    assert [segment["End Demand"] for segment in other["programmed_segments"]] == ["0 µN", "0 µN", "50000 µN", "0 µN"]
    assert len(other["approach_block"]["MotorDisp_mm"]) == 312
    assert len(other["drift_block"]["Disp_nm"]) == 913
    assert len(other["test_block_further_columns"]["LoadCell_nm"]) == 1068
    assert other["instrument_header"]["Drift Monitor Time"] == "40 s"


def test_hysitron_lc():
    campaign = read(INSTRUMENTS / LC)
    curve, other = campaign.curves[0], campaign.metadata.other
    assert len(curve) == 5304
    assert other["block_lengths"] == [201, 104, 2000, 1000, 1999]
    assert curve.displacement_um.min() < -0.049  # the approach is there
    assert curve.force_mN[0] == 1.836146 / 1e3
    assert len(other["further_columns"]["Depth (V)"]) == 5304


def test_micromaterials():
    campaign = read(INSTRUMENTS / ZIP)
    assert len(campaign) == 39
    assert campaign.particles[0] == "1000nmXX 1 6958 -4555"
    assert campaign.metadata.control is None
    curve = campaign.curves[0]
    assert (curve.displacement_um[0], curve.force_mN[0]) == (-367.982536 / 1e3, -0.010298)
    assert len({len(curve) for curve in campaign.curves}) > 10


@pytest.mark.parametrize("name", FILES)
def test_format_is_told_by_content_and_campaign_survives_files(tmp_path, name):
    disguised = tmp_path / "data.bin"
    disguised.write_bytes((INSTRUMENTS / name).read_bytes())
    campaign = read(disguised)
    write_campaign(campaign, tmp_path / "c")
    again = read_campaign(tmp_path / "c")
    assert_same(again, campaign)
    assert "data.bin" in (again.metadata.provenance or "")


def test_diameters(tmp_path):
    table = tmp_path / "d.csv"
    table.write_text("particle,D1_mm,D2_um,D3_um\nRobinSteel0000LC,0.2,190,180\n")
    diameters = read_diameters(table)
    campaign = read(INSTRUMENTS / LC, diameters_um=diameters)
    assert campaign.diameters_um.tolist() == [SIZES]
    assert read_diameters("200,190, 180") == SIZES


@pytest.mark.parametrize(
    ("diameters", "piece"),
    [
        (None, "--diameters"),
        ([1.0, 2.0], "three positive"),
        ([1.0, 2.0, -3.0], "three positive"),
        ([1.0, 2.0, float("nan")], "three positive"),
        ({}, "--diameters"),
        ({"x": SIZES}, "no diameters for 1 of 1 tests"),
        ({"RobinSteel0000LC": [1.0]}, "three positive"),
    ],
)
def test_bad_diameters(diameters, piece):
    assert piece in message(INSTRUMENTS / LC, diameters_um=diameters)


@pytest.mark.parametrize("text", ["1,2,x", "1,2,-3", "1,2,nan", "1,2", "nowhere.csv", ""])
def test_bad_diameters_on_the_command_line(text):
    with pytest.raises(InputError):
        read_diameters(text)


def lines_of(name: str) -> list[str]:
    return (INSTRUMENTS / name).read_bytes().decode("latin-1").split("\n")


DAMAGE = {
    # name of the file, what is done to its lines, what the message holds
    "fs cut between tests": (FS, lambda x: x[:7415], ["announces 10 tests, the file holds 6"]),
    "fs cut in a test": (FS, lambda x: x[:12000], ["'10'", "before its greatest force", "export it again"]),
    "fs cut in a row": (FS, lambda x: [*x[:500], "1,5\t0,2"], ["row 501", "2 cells where 3"]),
    "fs time": (FS, lambda x: [*x[:99], "1,5\t0,2\t0,1", *x[100:]], ["row 100", "goes back"]),
    "fs no samples": (FS, lambda x: x[:11110], ["'10' has no samples"]),
    "hld cut": (HLD, lambda x: x[:2000], ["row 1422", "Test announces 1068 rows"]),
    "hld no test": (HLD, lambda x: x[:1421], ["'Test Data Points' is missing"]),
    "hld text": (HLD, lambda x: [*x[:1500], x[1500].replace("\t", "\tx", 1), *x[1501:]], ["row 1501", "'Disp_nm'"]),
    "hld row short": (HLD, lambda x: [*x[:1500], "1\t2", *x[1501:]], ["row 1501", "2 cells where 8"]),
    "hld column": (HLD, lambda x: [s.replace("Disp_nm\tForce", "Disp\tForce") for s in x], ["'Disp_nm'"]),
    "lc cut": (LC, lambda x: x[:3000], ["row 3", "5304 points are announced"]),
    "lc text": (LC, lambda x: [*x[:99], "x" + x[99], *x[100:]], ["row 100", "'Depth (nm)'", "x"]),
    "lc column": (LC, lambda x: [s.replace("Time (s)", "Zeit") for s in x], ["row 4", "'Time (s)'"]),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_damaged_files(tmp_path, case):
    name, change, pieces = DAMAGE[case]
    path = tmp_path / name
    path.write_bytes("\n".join(change(lines_of(name))).encode("latin-1"))
    assert_holds(message(path), [str(path), *pieces])


def zipped(**files: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            # A date of its own would make other bytes every other second, and other names of tests in every worker.
            entry = zipfile.ZipInfo(name.replace("__", "/"))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    return buffer.getvalue()


ROWS = b"0.000000\t-1.000000\t0.000000\n1.000000\t2.000000\t0.100000\n2.000000\t3.000000\t0.200000\n"


def test_names_in_archives_are_names_only(tmp_path):
    (tmp_path / "a.zip").write_bytes(zipped(**{"..__..__evil.txt": ROWS, "deep__b.txt": ROWS}))
    assert read(tmp_path / "a.zip").particles == ("evil", "b")
    assert [path.name for path in tmp_path.iterdir()] == ["a.zip"]


def bomb() -> bytes:
    """An archive whose directory claims that an entry is far smaller than it is."""
    data = bytearray(zipped(**{"a.txt": ROWS * 100_000}))
    directory = data.rindex(b"PK\x01\x02")
    data[directory + 24 : directory + 28] = struct.pack("<I", 50)
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "piece"),
    [
        (zipped(), "holds no file"),
        (zipped(**{"a.txt": ROWS, "x__a.txt": ROWS}), "two tests are called 'a'"),
        (zipped(**{"a.txt": zipped(**{"b.txt": ROWS})}), "no Micro Materials text"),
        (zipped(**{"a.txt": b"hello\n"}), "no Micro Materials text"),
        (zipped(**{"a.txt": ROWS + b"3.000000\tx\t1.000000\n"}), "row 4, column 'h'"),
        (zipped(**{"a.txt": ROWS + b"3.000000\t1.000000"}), "row 4: 2 cells"),
        (zipped(**{"a.txt": ROWS + b"0.500000\t1.000000\t1.000000\n"}), "row 4: the time of test 'a' goes back"),
        (zipped(**{"a.txt": ROWS})[:-30], "damaged"),
        (zipped(**{"a.txt": ROWS})[:30], "damaged"),
        (zipped(**{"a.txt": ROWS}).replace(b"\x14\0\0\0\x08", b"\x14\0\1\0\x08"), "encrypted"),
        (bomb(), "damaged"),
    ],
    ids=lambda value: value if isinstance(value, str) else f"{len(value)} bytes",
)
def test_bad_archives(tmp_path, data, piece):
    (tmp_path / "a.zip").write_bytes(data)
    assert piece in message(tmp_path / "a.zip")


def test_too_large_archive(tmp_path, monkeypatch):
    (tmp_path / "a.zip").write_bytes(zipped(**{"a.txt": ROWS}))
    monkeypatch.setattr(micromaterials, "UNPACKED_BYTES", 50)
    assert "too large" in message(tmp_path / "a.zip")


@pytest.mark.parametrize(
    ("data", "piece"),
    [
        (b"", "empty"),
        (b"hello\nworld\n", "format is not known (known: Fischer HM export"),
        (b"time,force\n1,2\n", "--mapping"),
        (b"\x1f\x8b\x08junk", "gzip"),
        (b"\x89HDF\r\n", "HDF5"),
        (b"abc\0def", "NUL"),
    ],
)
def test_unknown_files(tmp_path, data, piece):
    (tmp_path / "x").write_bytes(data)
    assert piece in message(tmp_path / "x")


def test_missing_file(tmp_path):
    assert "no such file" in message(tmp_path / "none")
    assert "no instrument file in the folder" in message(tmp_path)
