# SPDX-License-Identifier: Apache-2.0
"""Importers on recordings made here in each app's own format, of one motion that is known."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import sqlite3
import sys
import zipfile
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io

from suspension_twin.drive import importers
from suspension_twin.drive.checks import gravity_of, rhythm_of, summarise
from suspension_twin.drive.clocks import gps_to_posix, iso_to_posix, text_to_posix, week_to_posix
from suspension_twin.drive.importers import IMPORTERS, matlab_mobile
from suspension_twin.drive.importing import import_drive
from suspension_twin.drive.mapping import load_mapping
from suspension_twin.drive.read import read_drive
from suspension_twin.drive.streams import velocities_from_course, velocities_from_fixes
from suspension_twin.drive.types import Drive, FixData
from suspension_twin.drive.unpack import Budget
from suspension_twin.drive.write import write_drive
from suspension_twin.errors import InputError
from suspension_twin.files import reading
from suspension_twin.inference.observation import observe
from suspension_twin.inference.placement import is_open
from suspension_twin.inference.simulated import simulate_drive
from suspension_twin.vehicle.twin import Twin, load_twin

G = 9.80665
START_NS = 1_714_557_600_000_000_000  # 2024-05-01 10:00:00 UTC
START = START_NS * 1e-9

RNG = np.random.default_rng(5)
T = np.arange(400) / 100  # s
TG = np.arange(200) / 50  # the gyroscope at half the rate, beginning a little later
TL = np.arange(5) * 1.0
LINEAR = RNG.normal(size=(400, 3))
GRAVITY = np.tile([0.0, 0.0, G], (400, 1))
FORCE = LINEAR + GRAVITY  # as Android gives it: +g on z, lying face up
RATE = np.stack([np.sin(TG), np.cos(TG), 0.1 * TG], axis=1)
LATITUDE, LONGITUDE = 47.4 + TL * 9e-5, np.full(5, 19.2)
SPEED, BEARING = np.full(5, 10.0), np.full(5, 90.0)
ALTITUDE, ACCURACY, VERTICAL = np.full(5, 120.0), 5.0, 3.0
QUALITY = [1, 2, 5, 4, 7]  # of RTKLIB
EAST = np.stack([SPEED, np.zeros(5), np.zeros(5)], axis=1)


def test_every_file_of_the_folder_is_registered() -> None:
    """An importer is found by its file name: one that is forgotten here would never be asked."""
    folder = Path(importers.__file__).parent
    assert {p.stem for p in folder.glob("*.py")} - {"__init__"} == set(IMPORTERS)
    assert len(IMPORTERS) == len(set(IMPORTERS))
    for name in IMPORTERS:
        importer = IMPORTERS[name]
        assert importer.TITLE and importer.recognises.__doc__ and importer.read.__doc__
    with pytest.raises(InputError, match="abacus"):
        IMPORTERS.named("abacus", "importer")


# --- Sensor Logger


def _csv(path: Path, header: str, *columns: Any) -> None:
    rows = [",".join(str(v) for v in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")


def _xyz(path: Path, t: np.ndarray, values: np.ndarray) -> None:
    ns = [START_NS + round(x * 1e9) for x in t]
    _csv(path, "time,seconds_elapsed,z,y,x", ns, t, values[:, 2], values[:, 1], values[:, 0])


LOCATION = (
    "time,seconds_elapsed,bearingAccuracy,speedAccuracy,verticalAccuracy,horizontalAccuracy,"
    "speed,bearing,altitude,longitude,latitude"
)
METADATA = "version,device name,recording epoch time,recording time,platform,appVersion,standardisation"


def sensor_logger(
    folder: Path, platform: str | None = "android", standardised: bool = False, *, total: bool = True
) -> Path:
    """A folder as the app exports it; iOS negates the accelerometer and has no TotalAcceleration."""
    folder.mkdir(parents=True)
    sign = -1.0 if platform == "ios" and not standardised else 1.0
    if platform == "ios" or not total:
        _xyz(folder / "Accelerometer.csv", T, sign * LINEAR)
        _xyz(folder / "Gravity.csv", T, sign * GRAVITY)
    else:
        _xyz(folder / "TotalAcceleration.csv", T, FORCE)
        _xyz(folder / "Accelerometer.csv", T, LINEAR)
    _xyz(folder / "Gyroscope.csv", TG, RATE)
    (folder / "Barometer.csv").write_text("time,seconds_elapsed,relativeAltitude,pressure\n")
    ns = [START_NS + round(x * 1e9) for x in TL]
    ones = np.ones(TL.size)
    _csv(
        folder / "Location.csv",
        LOCATION,
        ns,
        TL,
        ones,
        ones,
        VERTICAL * ones,
        ACCURACY * ones,
        SPEED,
        BEARING,
        ALTITUDE,
        LONGITUDE,
        LATITUDE,
    )
    if platform is not None:
        row = f"3,phone,{START_NS // 10**6},2024-05-01_10-00-00,{platform},1.40,{str(standardised).lower()}"
        (folder / "Metadata.csv").write_text(f"{METADATA}\n{row}\n")
    return folder


def check(path: Path, *, force: np.ndarray = FORCE, tolerance: float = 1e-9) -> Any:
    """The motion, whatever the format."""
    imported = import_drive([path])
    drive = imported.drive
    inside = TG[-1] + 0.05 >= T
    np.testing.assert_allclose(drive.imu.t - START, T[inside], atol=1e-6)
    np.testing.assert_allclose(drive.imu.specific_force, force[inside], atol=tolerance)
    expected = np.stack([np.interp(T[inside], TG, RATE[:, i]) for i in range(3)], axis=1)
    np.testing.assert_allclose(drive.imu.angular_rate, expected, atol=1e-5)
    np.testing.assert_allclose(drive.fix.t - START, TL, atol=1e-6)
    np.testing.assert_allclose(drive.fix.latitude, LATITUDE, atol=1e-9)
    np.testing.assert_allclose(drive.fix.longitude, LONGITUDE, atol=1e-9)
    np.testing.assert_allclose(drive.velocity.enu, EAST, atol=1e-9)
    return imported


@pytest.mark.parametrize("platform", ["android", "ios"])
@pytest.mark.parametrize("standardised", [False, True])
def test_sensor_logger_of_both_platforms(platform: str, standardised: bool, tmp_path: Path) -> None:
    imported = check(sensor_logger(tmp_path / "rec", platform, standardised))
    assert ("iOS" in imported.origin) == (platform == "ios")
    assert gravity_of(imported.drive.imu.specific_force).axis == "+z"
    np.testing.assert_allclose(imported.drive.fix.sigma, np.tile([5 / np.sqrt(2), 5 / np.sqrt(2), 3], (5, 1)))
    assert imported.drive.warnings == ()


def test_sensor_logger_without_total_acceleration(tmp_path: Path) -> None:
    imported = check(sensor_logger(tmp_path / "rec", total=False))
    assert any("Accelerometer + Gravity" in note for note in imported.notes)


def test_sensor_logger_as_zip_with_and_without_a_folder_in_it(tmp_path: Path) -> None:
    folder = sensor_logger(tmp_path / "rec")
    check(Path(shutil.make_archive(str(tmp_path / "flat"), "zip", folder)))
    with zipfile.ZipFile(tmp_path / "wrapped.zip", "w") as archive:
        for file in folder.iterdir():
            archive.write(file, f"2024-05-01/{file.name}")
            archive.writestr(f"__MACOSX/2024-05-01/._{file.name}", b"\0\5\26\7")
    check(tmp_path / "wrapped.zip")


def test_sensor_logger_without_metadata_says_so(tmp_path: Path) -> None:
    imported = check(sensor_logger(tmp_path / "rec", None))
    assert any("names the platform" in line for line in imported.drive.warnings)


def test_sensor_logger_without_gravity_is_refused(tmp_path: Path) -> None:
    folder = sensor_logger(tmp_path / "rec")
    (folder / "TotalAcceleration.csv").unlink()
    with pytest.raises(InputError, match="without gravity"):
        import_drive([folder])
    (folder / "Accelerometer.csv").unlink()
    with pytest.raises(InputError, match="no accelerometer"):
        import_drive([folder])


def test_sensor_logger_without_gyroscope_is_refused(tmp_path: Path) -> None:
    folder = sensor_logger(tmp_path / "rec")
    (folder / "Gyroscope.csv").unlink()
    with pytest.raises(InputError, match="no gyroscope"):
        import_drive([folder])


def test_sensor_logger_marks_what_is_invalid(tmp_path: Path) -> None:
    """Negative accuracies, bearings and speeds mean that the phone does not know; fields may be empty."""
    folder = sensor_logger(tmp_path / "rec")
    lines = (folder / "Location.csv").read_text().splitlines()
    fields = [line.split(",") for line in lines]
    fields[2][6], fields[2][7] = "-1", "-1"  # speed, bearing
    fields[3][5] = "-1"  # horizontal accuracy
    fields[4][8] = ""  # altitude
    (folder / "Location.csv").write_text("\n".join(",".join(f) for f in fields) + "\n")
    drive = import_drive([folder]).drive
    assert len(drive.velocity) == 4
    assert drive.fix.status.tolist() == [0, 0, -1, 0, 0]
    assert np.isfinite(drive.fix.altitude).all()
    assert any("altitude" in line for line in drive.warnings)


def sensor_logger_json(platform: str) -> list[dict[str, str]]:
    sign = -1.0 if platform == "ios" else 1.0
    records: list[dict[str, str]] = [{"sensor": "Metadata", "platform": platform, "standardisation": "false"}]
    for sensor, t, values in (
        ("Accelerometer", T, sign * LINEAR),
        ("Gravity", T, sign * GRAVITY),
        ("Gyroscope", TG, RATE),
    ):
        for x, row in zip(t, values, strict=True):
            axes = dict(zip("zyx", map(str, row[::-1]), strict=True))
            records.append(
                {"sensor": sensor, "time": str(START_NS + round(x * 1e9)), "seconds_elapsed": str(x), **axes}
            )
    for i, x in enumerate(TL):
        values = dict(
            zip(
                LOCATION.split(",")[2:],
                map(
                    str,
                    (1, 1, VERTICAL, ACCURACY, SPEED[i], BEARING[i], ALTITUDE[i], LONGITUDE[i], LATITUDE[i]),
                ),
                strict=True,
            )
        )
        records.append(
            {
                "sensor": "Location",
                "time": str(START_NS + round(x * 1e9)),
                "seconds_elapsed": str(x),
                **values,
            }
        )
    return records


@pytest.mark.parametrize("platform", ["android", "ios"])
def test_sensor_logger_json_of_strings(platform: str, tmp_path: Path) -> None:
    path = tmp_path / "rec.json"
    path.write_text(json.dumps(sensor_logger_json(platform)))
    check(path)


def sensor_logger_database(path: Path, platform: str) -> None:
    """A table of texts for each sensor, in no order, beside one of the app's own."""
    by_sensor: dict[str, list[dict[str, str]]] = {}
    for record in sensor_logger_json(platform):
        by_sensor.setdefault(record["sensor"], []).append(record)
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE Annotation (time, seconds_elapsed, text)")
        for sensor, rows in by_sensor.items():
            names = [name for name in rows[0] if name != "sensor"]
            database.execute(f"CREATE TABLE {sensor} ({', '.join(names)})")
            marks = ", ".join("?" * len(names))
            database.executemany(
                f"INSERT INTO {sensor} VALUES ({marks})", [[row[n] for n in names] for row in rows]
            )
        database.commit()


@pytest.mark.parametrize("platform", ["android", "ios"])
def test_sensor_logger_database(platform: str, tmp_path: Path) -> None:
    path = tmp_path / "rec.sqlite"
    sensor_logger_database(path, platform)
    check(path)


def test_a_database_whose_tables_are_computed_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "rec.sqlite"
    with closing(sqlite3.connect(path)) as database:
        database.execute(
            "CREATE VIEW Gyroscope AS WITH RECURSIVE n(time) AS (SELECT 1 UNION ALL SELECT time + 1 FROM n) "
            "SELECT time, time AS seconds_elapsed, 0 AS x, 0 AS y, 0 AS z FROM n"
        )
        database.commit()
    with pytest.raises(InputError):
        import_drive([path])


def test_sensor_logger_json_that_is_cut_off(tmp_path: Path) -> None:
    text = json.dumps(sensor_logger_json("android"))
    path = tmp_path / "rec.json"
    path.write_text(text[: int(len(text) * 0.97)])
    imported = import_drive([path])
    assert any("cut off" in line for line in imported.drive.warnings)
    assert len(imported.drive.imu) > 300
    path.write_text(text[:300])
    with pytest.raises(InputError):
        import_drive([path])


# --- phyphox

PAUSE = 2.0  # s into the experiment
BREAK = 7.5  # s the pause lasted


def phyphox(
    folder: Path,
    delimiter: str = ",",
    comma: bool = False,
    language: str = "en",
    encoding: str = "utf-8",
    paused: bool = False,
) -> Path:
    """A folder as the app exports it: experiment time, numbers in scientific notation, quoted names."""
    (folder / "meta").mkdir(parents=True)

    def number(value: float) -> str:
        text = f"{value:.15E}"
        return text.replace(".", ",") if comma else text

    def table(name: str, head: list[str], *columns: np.ndarray) -> None:
        rows = [delimiter.join(f'"{h}"' for h in head)]
        rows += [delimiter.join(number(v) for v in row) for row in zip(*columns, strict=True)]
        (folder / name).write_text("\n".join(rows) + "\n", encoding=encoding)

    words = {
        "en": (
            "Time",
            "Acceleration",
            "Linear Acceleration",
            "Gyroscope",
            "Latitude",
            "Longitude",
            "Height",
            "Velocity",
            "Direction",
        ),
        "de": (
            "Zeit",
            "Beschleunigung",
            "Lineare Beschleunigung",
            "Gyroskop",
            "Breite",
            "Länge",
            "Höhe",
            "Geschwindigkeit",
            "Richtung",
        ),
    }[language]
    time = f"{words[0]} (s)"
    # in the folder the linear acceleration comes first, so that taking the first would be wrong
    table("A Linear.csv", [time, *(f"{words[2]} {a} (m/s^2)" for a in "xyz")], T, *LINEAR.T)
    table("Accelerometer.csv", [time, *(f"{words[1]} {a} (m/s^2)" for a in "xyz")], T, *FORCE.T)
    table("Gyroscope.csv", [time, *(f"{words[3]} {a} (rad/s)" for a in "xyz")], TG, *RATE.T)
    heads = [f"{words[4]} (°)", f"{words[5]} (°)", f"{words[6]} (m)", f"{words[7]} (m/s)", f"{words[8]} (°)"]
    heads += ["Horizontal Accuracy (m)", "Vertical Accuracy (m)"]
    table(
        "Location.csv",
        [time, *heads],
        TL,
        LATITUDE,
        LONGITUDE,
        ALTITUDE,
        SPEED,
        BEARING,
        np.full(TL.size, ACCURACY),
        np.full(TL.size, VERTICAL),
    )
    events = [("START", 0.0, START)]
    if paused:
        events += [("PAUSE", PAUSE, START + PAUSE), ("START", PAUSE, START + PAUSE + BREAK)]
    end = float(TL[-1]) + 1.0
    events.append(("PAUSE", end, START + end + (BREAK if paused else 0.0)))
    rows = [delimiter.join(f'"{h}"' for h in ("event", "experiment time", "system time", "system time text"))]
    for name, t, system in events:
        moment = f"{system:.3f}"
        rows.append(
            delimiter.join(
                [
                    f'"{name}"',
                    number(t),
                    moment.replace(".", ",") if comma else moment,
                    '"2024-05-01 12:00:00.000 UTC+02:00"',
                ]
            )
        )
    (folder / "meta" / "time.csv").write_text("\n".join(rows) + "\n", encoding=encoding)
    (folder / "meta" / "device.csv").write_text('"property","value"\n"version","1.1.16"\n')
    return folder


#: Latitude, longitude, altitude, accuracies and speed in languages of the app (its own translations).
PLACES = {
    "en": "Latitude;Longitude;Altitude;Horizontal Accuracy;Vertical Accuracy;Speed;Direction",
    "de": "Breitengrad;Längengrad;Höhe;Horizontale Genauigkeit;Vertikale Genauigkeit;Geschwindigkeit;Richtung",
    "cs": "Zeměpisná šířka;Zeměpisná délka;Výška;Horizontální přesnost;Vertikální přesnost;Rychlost;Směr",
    "pl": "Szerokość geograficzna;Długość;Wysokość;Dokładność w poziomie;Dokładność w pionie;Szybkość;Kierunek",
    "nl": "Breedtegraad;Lengtegraad;Hoogte;Horizontale Nauwkeurigheid;Verticale Nauwkeurigheid;Snelheid;Richting",
    "ru": "Широта;Долгота;Высота;Горизонтальная точность;Вертикальная точность;Скорость;Направление",
    "it": "Latitudine;Longitudine;Altezza;Accuratezza orizzontale;Accuratezza verticale;Velocità;Direzione",
    "el": "Γεωγραφικό Πλάτος;Γεωγραφικό Μήκος;Υψόμετρο;Οριζόντια ακρίβεια;Κατακόρυφη ακρίβεια;Ταχύτητα;Κατεύθυνση",
    "ja": "緯度;経度;高度;水平方向精度;垂直方向精度;速度;方位",
    "pt": "Latitude;Longitude;Altura;Precisão Horizontal;Precisão Vertical;Velocidade;Direção",
    "tr": "Enlem;Boylam;Yükseklik;Yatay doğruluk;Dikey doğruluk;Hız;Yön",
    "zh_Hant": "緯度;經度;高度;水平精準度;鉛直精準度;速度;方向",
    "zh_Hans": "纬度;经度;高度;平面位置精度;垂直位置精度;速度;方向",
    "fr": "Latitude;Longitude;Altitude;Précision horizontale;Précision verticale;Vitesse;Direction",
    "vi": "Vĩ độ;Kinh độ;Độ cao;Sai số ngang;Sai số cao;Tốc độ;Hướng",
    "sr_Latn": "Širina;Dužina;Visina;Horizontalna tačnost;Vertikalna tačnost;Brzina;Pravac",
    "es": "Latitud;Longitud;Altitud;Precisión horizontal;Precisión vertical;Velocidad;Dirección",
}
#: Those whose words are not known here: the order of the app decides.
ORDERED = {"xx": "aa;bb;cc;dd;ee;ff;gg", "hi": "ऊँचाई;देशांतर;ऊँचाई;क्षैतिज यथार्थता;उर्ध्वाधर यथार्थता;चाल;दिशा"}


@pytest.mark.parametrize("altitude", [650.0, -20.0])
@pytest.mark.parametrize("language", [*PLACES, *ORDERED])
def test_phyphox_reads_a_location_by_the_names_of_its_columns(
    language: str, altitude: float, tmp_path: Path
) -> None:
    """The app's own GPS experiment exports two altitudes; the one over the ellipsoid counts, and may be negative."""
    folder = phyphox(tmp_path / "rec")
    latitude, longitude, height, *accuracies, speed, course = (PLACES | ORDERED)[language].split(";")
    columns = {
        f"{latitude} (°)": LATITUDE,
        f"{longitude} (°)": LONGITUDE,
        f"{height} (m)": np.full(5, altitude - 48.0),
        f"{height} WGS84 (m)": np.full(5, altitude),
        f"{speed} (m/s)": SPEED,
        f"{course} (°)": BEARING,
        "Distance (km)": np.arange(5.0),
        f"{accuracies[0]} (m)": np.full(5, 3.0),
        f"{accuracies[1]} (m)": np.full(5, 4.0),
        "Satellites": np.full(5, 14.0),
    }
    names = list(columns)
    if language in PLACES:
        np.random.default_rng(len(language) + int(abs(altitude))).shuffle(names)
    lines = [",".join(["Time (s)", *names])]
    lines += [
        ",".join(map(repr, map(float, row))) for row in zip(TL, *(columns[n] for n in names), strict=True)
    ]
    (folder / "Location.csv").write_text("\n".join(lines))
    drive = check(folder).drive
    np.testing.assert_allclose(drive.fix.altitude, altitude)
    np.testing.assert_allclose(drive.fix.sigma[0], [3 / np.sqrt(2), 3 / np.sqrt(2), 4.0])


@pytest.mark.parametrize(
    ("delimiter", "comma"), [(",", False), ("\t", False), (";", False), (";", True), ("\t", True)]
)
@pytest.mark.parametrize("language", ["en", "de"])
def test_phyphox_delimiters_and_languages(delimiter: str, comma: bool, language: str, tmp_path: Path) -> None:
    imported = check(phyphox(tmp_path / "rec", delimiter, comma, language))
    assert imported.origin == "phyphox" and imported.drive.warnings == ()


def test_phyphox_as_zip_and_in_latin_1(tmp_path: Path) -> None:
    folder = phyphox(tmp_path / "rec", ";", True, "de", encoding="latin-1")
    imported = check(Path(shutil.make_archive(str(tmp_path / "rec"), "zip", folder)))
    assert any("Latin-1" in line for line in imported.drive.warnings)


def test_phyphox_paused(tmp_path: Path) -> None:
    """The experiment's time stands still in a pause, the clock does not."""
    drive = import_drive([phyphox(tmp_path / "rec", paused=True)]).drive
    before = T <= PAUSE
    np.testing.assert_allclose(drive.imu.t[: before.sum()] - START, T[before], atol=1e-6)
    after = drive.imu.t[before.sum() :] - START
    np.testing.assert_allclose(after, T[~before][: after.size] + BREAK, atol=1e-6)
    assert [round(length, 1) for _, length in rhythm_of(drive.imu.t).gaps] == [BREAK]
    assert drive.fix.t[-1] - START == pytest.approx(TL[-1] + BREAK)


def test_phyphox_without_its_time_reference(tmp_path: Path) -> None:
    folder = phyphox(tmp_path / "rec")
    shutil.rmtree(folder / "meta")
    drive = import_drive([folder]).drive
    assert drive.imu.t[0] == 0.0
    assert any("time.csv" in line for line in drive.warnings)


def test_phyphox_without_gravity_is_refused(tmp_path: Path) -> None:
    folder = phyphox(tmp_path / "rec")
    (folder / "Accelerometer.csv").unlink()
    with pytest.raises(InputError, match="without gravity"):
        import_drive([folder])


# --- MATLAB Mobile


def _logs(time: Callable[[np.ndarray], Any]) -> dict[str, dict[str, Any]]:
    position = {"latitude": LATITUDE, "longitude": LONGITUDE, "altitude": ALTITUDE}
    position |= {"speed": SPEED, "course": BEARING, "hacc": np.full(TL.size, ACCURACY)}
    return {
        "Acceleration": {"Timestamp": time(T), **{a: FORCE[:, i] for i, a in enumerate("XYZ")}},
        "AngularVelocity": {"Timestamp": time(TG), **{a: RATE[:, i] for i, a in enumerate("XYZ")}},
        "Position": {"Timestamp": time(TL), **position},
    }


TIMES: dict[str, Callable[[np.ndarray], Any]] = {
    "posix": lambda t: START + t,
    "milliseconds": lambda t: (START + t) * 1e3,
    "text": lambda t: np.array([f"01-May-2024 10:00:{x:06.3f}" for x in t], dtype=object),
}


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no mat-io for Python 3.10")
@pytest.mark.parametrize("clock", list(TIMES))
@pytest.mark.parametrize("nested", [False, True])
def test_matlab_structs(clock: str, nested: bool, tmp_path: Path) -> None:
    logs = _logs(TIMES[clock])
    scipy.io.savemat(tmp_path / "log.mat", {"s": logs} if nested else logs)
    check(tmp_path / "log.mat", tolerance=1e-9)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no mat-io for Python 3.10")
def test_matlab_serial_day_numbers(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "log.mat", _logs(lambda t: 719_529 + (START + t) / 86_400))
    drive = import_drive([tmp_path / "log.mat"]).drive
    np.testing.assert_allclose(
        drive.imu.t - START, T[: len(drive.imu)], atol=1e-4
    )  # a day number holds 10 µs


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no mat-io for Python 3.10")
def test_matlab_arrays(tmp_path: Path) -> None:
    matlab_arrays(tmp_path / "log.mat")
    check(tmp_path / "log.mat")
    scipy.io.savemat(tmp_path / "no_time.mat", {"Acceleration": FORCE, "AngularVelocity": RATE})
    with pytest.raises(InputError, match="acceleration_t"):
        import_drive([tmp_path / "no_time.mat"])


def matlab_arrays(path: Path) -> None:
    """What ``[log, t] = accellog(m)`` leaves in a workspace."""
    logs = {
        "Acceleration": FORCE,
        "Acceleration_t": START + T,
        "AngularVelocity": RATE,
        "t_AngularVelocity": START + TG,
    }
    place = np.column_stack(
        [START + TL, LATITUDE, LONGITUDE, ALTITUDE, SPEED, BEARING, np.full(TL.size, ACCURACY)]
    )
    scipy.io.savemat(path, {**logs, "Position": place})


def test_matlab_csv(tmp_path: Path) -> None:
    check(matlab_csv(tmp_path / "log"))


def matlab_csv(folder: Path) -> Path:
    """``writetimetable`` of each log."""
    folder.mkdir()
    for name, columns in _logs(lambda t: _clock("%d-%b-%Y %H:%M:%S.{ms}", t)).items():
        _csv(folder / f"{name}.csv", ",".join(columns), *columns.values())
    return folder


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no mat-io for Python 3.10")
def test_matlab_timetables(tmp_path: Path) -> None:
    """As the app logs them: objects that SciPy leaves closed.

    The file was written by mat-io 1.0.2: Acceleration of 60 rows every 10 ms from 2024-05-01 10:00:00 with
    X = sin(i), Y = cos(i), Z = 9.81 + i / 1000, AngularVelocity of 30 rows every 20 ms a tenth of that, and
    Position of 3 rows every second, 10 m/s to the east.
    """
    path = Path(__file__).parent / "data" / "matlab_mobile_timetables.mat"
    drive = import_drive([path]).drive
    i = np.arange(60)
    np.testing.assert_allclose(drive.imu.t, START + i / 100, atol=1e-6)
    np.testing.assert_allclose(
        drive.imu.specific_force, np.stack([np.sin(i), np.cos(i), 9.81 + i / 1000], axis=1)
    )
    k = np.arange(30)
    by_gyroscope = drive.imu.angular_rate[::2]
    np.testing.assert_allclose(
        by_gyroscope, 0.1 * np.stack([np.sin(k), np.cos(k), 9.81 + k / 1000], axis=1), atol=1e-5
    )
    np.testing.assert_allclose(drive.fix.latitude, 47.4 + np.arange(3) * 1e-4)
    np.testing.assert_allclose(drive.velocity.enu, np.tile([10.0, 0, 0], (3, 1)), atol=1e-9)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(150):
        damaged = bytearray(data[: rng.integers(1, len(data) + 1)])
        for at in rng.integers(0, len(damaged), rng.integers(0, 9)):
            damaged[at] = rng.integers(256)
        (tmp_path / "log.mat").write_bytes(damaged)
        # in this process: one of its own for each takes seconds
        with contextlib.suppress(InputError), reading("log.mat", "a .mat file"):
            matlab_mobile._logs_of_variables(str(tmp_path / "log.mat"), Budget("log.mat", len(damaged)))


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no mat-io for Python 3.10")
def test_matlab_files_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mat"
    scipy.io.savemat(path, {"weather": np.arange(3)})
    with pytest.raises(InputError, match=r"weather"):
        import_drive([path])
    scipy.io.savemat(path, _logs(TIMES["posix"]), do_compression=True)
    whole = path.read_bytes()
    for end in (0, 3, 100, 130, 1000, len(whole) // 2):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError), reading(path, "a .mat file"):
            matlab_mobile._logs_of_variables(str(path), Budget(path, end))
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124, b" ") + b"\x00\x02IM" + bytes(400))
    with pytest.raises(InputError, match="damaged"):
        import_drive([path])


@pytest.mark.skipif(sys.version_info < (3, 11), reason="no mat-io for Python 3.10")
def test_matlab_timetables_of_version_73(tmp_path: Path) -> None:
    """HDF5, as ``save -v7.3`` writes it."""
    import matio
    import pandas

    logs = {}
    for name, t, values in (("Acceleration", T, FORCE), ("AngularVelocity", TG, RATE)):
        stamps = pandas.to_datetime(np.rint((START + t) * 1e6).astype(np.int64), unit="us")
        index = pandas.Index(stamps.astype("datetime64[ns]"), name="Timestamp")
        logs[name] = pandas.DataFrame(values, columns=list("XYZ"), index=index)
    matio.save_to_mat(str(tmp_path / "log.mat"), logs, version="v7.3")
    drive = import_drive([tmp_path / "log.mat"]).drive
    np.testing.assert_allclose(drive.imu.t - START, T[: len(drive.imu)], atol=2e-6)
    np.testing.assert_allclose(drive.imu.specific_force, FORCE[: len(drive.imu)])


# --- RTKLIB

POS_HEAD = (
    "%  {system}                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    "  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
)


def _pos(
    path: Path,
    system: str = "GPST",
    *,
    week: bool = False,
    dms: bool = False,
    separator: str = " ",
    velocity: bool = True,
) -> Path:
    shift = 18.0 if system == "GPST" else 9 * 3600.0 if system == "JST" else 0.0
    head = POS_HEAD.format(system=system).replace("(deg)", "(d'\")" if dms else "(deg)")
    lines = [
        "% program   : RTKPOST ver.2.4.3",
        head + ("    vn(m/s)    ve(m/s)    vu(m/s)" if velocity else ""),
    ]
    for i, t in enumerate(TL):
        moment = START + t + shift
        if week:
            since = moment - 315_964_800.0
            fields = [f"{int(since // 604800)}", f"{since % 604800:.3f}"]
        else:
            import datetime

            when = datetime.datetime.fromtimestamp(moment, tz=datetime.timezone.utc)
            fields = [
                when.strftime("%Y/%m/%d"),
                when.strftime("%H:%M:%S.") + f"{when.microsecond // 1000:03d}",
            ]
        for angle in (LATITUDE[i], LONGITUDE[i]):
            if dms:
                minutes = (angle - int(angle)) * 60
                fields += [str(int(angle)), str(int(minutes)), f"{(minutes - int(minutes)) * 60:.7f}"]
            else:
                fields.append(f"{angle:.9f}")
        fields += [
            str(ALTITUDE[i]),
            str(QUALITY[i]),
            "20",
            "0.02",
            "0.01",
            "0.03",
            "0",
            "0",
            "0",
            "0.5",
            "3.1",
        ]
        course = np.radians(BEARING[i])
        enu = [SPEED[i] * np.cos(course), SPEED[i] * np.sin(course), 0.0]
        fields += [f"{v:.9f}" for v in enu] if velocity else []
        lines.append(separator.join(fields))
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"system": "UTC"},
        {"system": "JST"},
        {"week": True},
        {"dms": True},
        {"separator": ","},
        {"separator": " , ", "week": True},
    ],
)
def test_rtklib_variants_with_a_phones_imu(options: dict[str, Any], tmp_path: Path) -> None:
    """A receiver's solution takes the place of the phone's own positions."""
    pos = _pos(tmp_path / "gnss.pos", **options)
    imported = import_drive([sensor_logger(tmp_path / "rec"), pos])
    drive = imported.drive
    np.testing.assert_allclose(drive.fix.t - START, TL, atol=2e-3)
    np.testing.assert_allclose(drive.fix.latitude, LATITUDE, atol=1e-8)
    np.testing.assert_allclose(drive.fix.longitude, LONGITUDE, atol=1e-8)
    np.testing.assert_allclose(drive.velocity.enu, EAST)
    assert drive.fix.status.tolist() == [2, 2, 0, 2, -1]
    np.testing.assert_allclose(drive.fix.sigma[0], [0.01, 0.02, 0.03])
    assert any("fix from RTKLIB" in note for note in imported.notes)


def test_rtklib_without_velocities_derives_them_from_its_own_positions(tmp_path: Path) -> None:
    pos = _pos(tmp_path / "gnss.pos", velocity=False)
    imported = import_drive([sensor_logger(tmp_path / "rec"), pos])
    np.testing.assert_allclose(imported.drive.velocity.enu[:, 1], 9e-5 * 111_180, rtol=1e-2)  # due north
    assert any("derived from the positions" in note for note in imported.notes)


def test_rtklib_ecef(tmp_path: Path) -> None:
    """x, y, z with their covariances, turned to latitude, longitude, height and east, north, up."""
    import pymap3d

    x, y, z = pymap3d.geodetic2ecef(LATITUDE, LONGITUDE, np.full(5, 120.0))
    lines = [
        "%  UTC  x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio "
        "vx(m/s) vy(m/s) vz(m/s)"
    ]
    vx, vy, vz = pymap3d.enu2uvw(10.0, 0.0, 0.0, LATITUDE, LONGITUDE)
    for i, t in enumerate(TL):
        # the covariance of 1 cm east, 2 cm north, 5 cm up
        rotation = np.stack(
            [np.array(pymap3d.enu2uvw(*row, LATITUDE[i], LONGITUDE[i])).ravel() for row in np.eye(3)], axis=1
        )
        c = rotation @ np.diag([0.01, 0.02, 0.05]) ** 2 @ rotation.T
        off = [np.sign(v) * np.sqrt(abs(v)) for v in (c[0, 1], c[1, 2], c[2, 0])]
        sd = " ".join(f"{v:.9f}" for v in (*np.sqrt(np.diag(c)), *off))
        lines.append(
            f"2024/05/01 10:00:{t:06.3f} {x[i]:.6f} {y[i]:.6f} {z[i]:.6f} 1 20 {sd} 0 0 "
            f"{vx[i]:.9f} {vy[i]:.9f} {vz[i]:.9f}"
        )
    (tmp_path / "gnss.pos").write_text("\n".join(lines) + "\n")
    drive = import_drive([sensor_logger(tmp_path / "rec"), tmp_path / "gnss.pos"]).drive
    np.testing.assert_allclose(drive.fix.latitude, LATITUDE, atol=1e-9)
    np.testing.assert_allclose(drive.fix.altitude, 120.0, atol=1e-4)
    np.testing.assert_allclose(drive.fix.sigma, np.tile([0.01, 0.02, 0.05], (5, 1)), rtol=1e-5)
    np.testing.assert_allclose(drive.velocity.enu, EAST, atol=1e-6)


def test_rtklib_files_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "gnss.pos"
    for text, words in {
        "": "no positions",
        "% only a header\n": "no positions",
        "%  GPST  e-baseline(m) n-baseline(m) u-baseline(m) Q ns\n2024/05/01 10:00:00 1 2 3 1 20\n": "no positions",
        "%  GPST  latitude(deg) longitude(deg) height(m) Q ns\nyesterday noon 1 2 3 1 20\n": "week",
    }.items():
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            import_drive([path])
    with pytest.raises(InputError, match="no accelerometer data: give the IMU's file too$"):
        import_drive([_pos(path)])


def test_a_file_that_nobody_read_is_named_where_there_is_no_imu(tmp_path: Path) -> None:
    _pos(tmp_path / "gnss.pos")
    (tmp_path / "imu.csv").write_text("0.1,0.0,1.0\n")
    with pytest.raises(InputError, match=r"--mapping if it is one of those not recognised: [^,]*imu\.csv$"):
        import_drive([tmp_path])


# --- one table of all sensors (logger_csv, and Sensor Logger's)


def _resampled(values: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.array([np.interp(T, t, column) for column in np.atleast_2d(values.T)]).T


def _held(values: np.ndarray) -> list[float]:
    """Values of a receiver in the rows of a faster sensor."""
    return [float(values[k]) for k in _latest()]


def _latest() -> np.ndarray:
    """The fix of each row."""
    return np.maximum(np.searchsorted(TL, T, side="right") - 1, 0)


def _place_columns() -> tuple[list[float], ...]:
    return tuple(_held(v) for v in (LATITUDE, LONGITUDE, ALTITUDE, SPEED, BEARING))


def _clock(form: str, times: np.ndarray | None = None) -> list[str]:
    """Stamps of the samples, as an app writes them with milliseconds."""
    times = T if times is None else times
    moments = [datetime.fromtimestamp(START + t, tz=timezone.utc) for t in times]
    return [moment.strftime(form).format(ms=f"{round(moment.microsecond / 1000):03}") for moment in moments]


def androsensor(path: Path) -> None:
    latitude, longitude, altitude, speed, course = _place_columns()
    head = [
        *(f"ACCELEROMETER {a} (m/s²)" for a in "XYZ"),
        *(f"GRAVITY {a} (m/s²)" for a in "XYZ"),
        *(f"GYROSCOPE {a} (rad/s)" for a in "XYZ"),
        "LOCATION Latitude : ",
        "LOCATION Longitude : ",
        "LOCATION Altitude ( m)",
        "LOCATION Altitude-google ( m)",
        "LOCATION Speed ( Kmh)",
        "LOCATION Accuracy ( m)",
        "LOCATION ORIENTATION (°)",
        "Satellites in range",
        "Time since start in ms ",
        "YYYY-MO-DD HH-MI-SS_SSS",
    ]
    columns = [
        *FORCE.T,
        *GRAVITY.T,
        *_resampled(RATE, TG).T,
        latitude,
        longitude,
        altitude,
        [f"{a - 40}" for a in altitude],
    ]
    columns += [[3.6 * v for v in speed], [ACCURACY] * T.size, course, ["7 / 12"] * T.size, 1000.0 * T]
    rows = zip(*columns, _clock("%Y-%m-%d %H:%M:%S:{ms}"), strict=True)
    path.write_text("\n".join(["sep=;", ";".join(head), *(";".join(map(str, row)) for row in rows)]))


def sensorlog(path: Path) -> None:
    latitude, longitude, altitude, speed, course = _place_columns()
    head = [
        "loggingTime(txt)",
        "locationTimestamp_since1970(s)",
        "locationLatitude(WGS84)",
        "locationLongitude(WGS84)",
    ]
    head += ["locationAltitude(m)", "locationSpeed(m/s)", "locationCourse(°)", "locationVerticalAccuracy(m)"]
    head += ["locationHorizontalAccuracy(m)", "accelerometerTimestamp_sinceReboot(s)"]
    head += [f"accelerometerAcceleration{a}(G)" for a in "XYZ"] + [f"gyroRotation{a}(rad/s)" for a in "XYZ"]
    columns = [_clock("%Y-%m-%d %H:%M:%S.{ms} +0000"), T, latitude, longitude, altitude, speed, course]
    columns += [[VERTICAL] * T.size, [ACCURACY] * T.size, T + 99.0, *(-FORCE.T / G), *_resampled(RATE, TG).T]
    path.write_text(
        "\n".join([",".join(head), *(",".join(map(str, row)) for row in zip(*columns, strict=True))])
    )


def physics_toolbox(path: Path, seconds: bool) -> None:
    latitude, longitude, _, speed, course = _place_columns()
    head = "time,gFx,gFy,gFz,TgF,ax,ay,az,wx,wy,wz,Latitude,Longitude,Speed (m/s),Bearing"
    stamps = T if seconds else _clock("%H:%M:%S:{ms}")
    columns = [stamps, *(FORCE.T / G), np.linalg.norm(FORCE, axis=1) / G, *LINEAR.T, *_resampled(RATE, TG).T]
    columns += [latitude, longitude, speed, course]
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in zip(*columns, strict=True))]))


def racechrono(path: Path) -> None:
    latitude, longitude, altitude, speed, course = _place_columns()
    head = "timestamp,fragment_id,elapsed_time,altitude,bearing,latitude,longitude,speed,"
    head += "x_acc,y_acc,z_acc,device_update_rate,x_rate_of_rotation,y_rate_of_rotation,z_rate_of_rotation"
    units = "unix time,,s,m,deg,deg,deg,m/s,G,G,G,Hz,deg/s,deg/s,deg/s"
    columns = [START + T, [0] * T.size, T, altitude, course, latitude, longitude, speed, *(FORCE.T / G)]
    columns += [[100] * T.size, *np.degrees(_resampled(RATE, TG)).T]
    rows = [",".join(map(repr, map(float, row))) for row in zip(*columns, strict=True)]
    path.write_text(
        "\n".join(["Created by an app", "Format,3", "", "Note,", "", head, units, "," * 14, *rows])
    )


def sensor_logger_combined(path: Path) -> None:
    latitude, longitude, altitude, speed, course = _place_columns()
    head = [
        "time",
        "seconds_elapsed",
        *(f"gyroscope_{a}" for a in "zyx"),
        *(f"totalAcceleration_{a}" for a in "zyx"),
    ]
    head += ["location_horizontalAccuracy", "location_verticalAccuracy", "location_speed", "location_bearing"]
    head += ["location_altitude", "location_longitude", "location_latitude"]
    rate, fresh = _resampled(RATE, TG), np.diff(_latest(), prepend=-1) > 0
    rows = []
    for i, t in enumerate(T):
        row = [START_NS + round(t * 1e9), t, *rate[i, ::-1], *FORCE[i, ::-1]]
        place = [ACCURACY, VERTICAL, speed[i], course[i], altitude[i], longitude[i], latitude[i]]
        rows.append([*row, *(place if fresh[i] else [""] * 7)])
    path.write_text("\n".join([",".join(head), *(",".join(map(str, row)) for row in rows)]))


@pytest.mark.parametrize(
    ("name", "write", "origin"),
    [
        ("androsensor", androsensor, "AndroSensor"),
        ("sensorlog", sensorlog, "SensorLog"),
        ("racechrono", racechrono, "RaceChrono"),
        ("sensor_logger", sensor_logger_combined, "Sensor Logger"),
    ],
)
def test_one_table_of_all_sensors(
    name: str, write: Callable[[Path], None], origin: str, tmp_path: Path
) -> None:
    write(tmp_path / f"{name}.csv")
    imported = import_drive([tmp_path / f"{name}.csv"])
    assert imported.origin == origin
    drive = imported.drive
    np.testing.assert_allclose(drive.imu.t - START, T, atol=1e-3)
    np.testing.assert_allclose(drive.imu.specific_force, FORCE, atol=1e-9)
    np.testing.assert_allclose(drive.imu.angular_rate, _resampled(RATE, TG), atol=1e-9)
    some = T[-1] >= TL
    np.testing.assert_allclose(drive.fix.t - START, TL[some], atol=1e-3)
    np.testing.assert_allclose(drive.fix.latitude, LATITUDE[some], atol=1e-9)
    np.testing.assert_allclose(drive.fix.altitude, 120.0)
    np.testing.assert_allclose(drive.velocity.enu, EAST[some], atol=1e-9)
    if origin != "RaceChrono":
        np.testing.assert_allclose(drive.fix.sigma[:, 0], 5.0 / np.sqrt(2.0))


def test_a_receiver_that_stands_is_no_gap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its place does not change from row to row, as between two fixes."""
    for name in ("LATITUDE", "LONGITUDE", "SPEED"):
        monkeypatch.setitem(globals(), name, np.full(5, 0.5))
    androsensor(tmp_path / "log.csv")
    fix = import_drive([tmp_path / "log.csv"]).drive.fix
    assert (
        fix.t[0] == pytest.approx(START, abs=1e-3)
        and np.diff(fix.t).min() > 0.9
        and np.diff(fix.t).max() < 2.0
    )


@pytest.mark.parametrize("seconds", [False, True])
def test_physics_toolbox_has_no_date(seconds: bool, tmp_path: Path) -> None:
    physics_toolbox(tmp_path / "log.csv", seconds)
    imported = import_drive([tmp_path / "log.csv"])
    assert imported.origin == "Physics Toolbox"
    assert any("no date" in text for text in imported.drive.warnings)
    start = 0.0 if seconds else START % 86400
    np.testing.assert_allclose(imported.drive.imu.t - start, T, atol=1e-3)
    np.testing.assert_allclose(imported.drive.imu.specific_force, FORCE, atol=1e-9)
    np.testing.assert_allclose(imported.drive.imu.angular_rate, _resampled(RATE, TG), atol=1e-9)
    np.testing.assert_allclose(imported.drive.velocity.enu, EAST[T[-1] >= TL], atol=1e-9)


def vbo(path: Path, inertial: bool, unit: str = "kmh", midnight: bool = False) -> float:
    """A file of a VBOX; returns the POSIX time of its first row."""
    start = START - START % 86400 + (86398.0 if midnight else 36000.5)
    names = "sats time lat long velocity heading height vert-vel"
    header = ["satellites", "time", "latitude", "longitude", f"velocity {unit}", "heading", "height"]
    factor = {"kmh": 3.6, "knots": 3600 / 1852, "mph": 1 / 0.44704}[unit]
    if inertial:
        names += " x_accel y_accel z_accel rollrate pitchrate yawrate"
    day = datetime.fromtimestamp(start, tz=timezone.utc)
    rows, latest = [], _latest() if inertial else np.arange(TL.size)
    rate = _resampled(RATE, TG)
    for i, t in enumerate(T if inertial else TL):
        moment = datetime.fromtimestamp(start + t, tz=timezone.utc)
        k = latest[i]
        row = [f"{73 if i else 64:03}", moment.strftime("%H%M%S.") + f"{round(moment.microsecond / 1e3):03}"]
        row += [f"{60 * LATITUDE[k]:+014.8f}", f"{-60 * LONGITUDE[k]:+014.8f}", f"{factor * SPEED[k]:07.3f}"]
        row += [f"{BEARING[k]:06.2f}", f"{ALTITUDE[k]:+.2f}", "+000.00"]
        if inertial:
            row += [f"{v:+.9f}" for v in (*FORCE[i] / G, *np.degrees(rate[i]))]
        rows.append(" ".join(row))
    first = f"File created on {day:%d/%m/%Y} @ {day:%H:%M:%S}"
    text = [
        first,
        "",
        "[header]",
        *header,
        "",
        "[comments]",
        "Log Rate (Hz) : 100.00",
        "",
        "[column names]",
        names,
        "",
    ]
    path.write_text("\r\n".join([*text, "[data]", *rows, ""]))
    return start


@pytest.mark.parametrize("midnight", [False, True])
@pytest.mark.parametrize("unit", ["kmh", "knots", "mph"])
def test_a_vbo_gives_positions_to_an_imu(unit: str, midnight: bool, tmp_path: Path) -> None:
    """Minutes, west positive, the day of its first line; without satellites there is no fix."""
    files, mapping, start = vbo_and_table(tmp_path, unit, midnight)
    drive = import_drive(files, mapping=mapping).drive
    np.testing.assert_allclose(drive.fix.t - start, TL, atol=0.006)
    np.testing.assert_allclose(drive.fix.latitude, LATITUDE, atol=1e-9)
    np.testing.assert_allclose(drive.fix.longitude, LONGITUDE, atol=1e-9)
    assert drive.fix.status.tolist() == [-1, 2, 2, 2, 2]
    np.testing.assert_allclose(drive.velocity.enu, EAST, atol=1e-3)


def vbo_and_table(folder: Path, unit: str = "kmh", midnight: bool = False) -> tuple[list[Path], Path, float]:
    """A VBO file of positions, a table of an IMU, the mapping of both, and the POSIX time of their first rows."""
    start = vbo(folder / "track.vbo", False, unit, midnight)
    _csv(folder / "imu.csv", "t,ax,ay,az,gx,gy,gz", start + T, *FORCE.T, *_resampled(RATE, TG).T)
    (folder / "map.yaml").write_text(
        "imu:\n  file: imu.csv\n  time: {column: t}\n  specific_force: {columns: [ax, ay, az], unit: m/s2}\n"
        "  angular_rate: {columns: [gx, gy, gz], unit: rad/s}\nfix: {file: track.vbo, importer: vbo}\n"
        "vel: {file: track.vbo, importer: vbo}\n"
    )
    return [folder / "imu.csv", folder / "track.vbo"], folder / "map.yaml", start


def test_a_vbo_with_an_imu_is_a_drive(tmp_path: Path) -> None:
    start = vbo(tmp_path / "track.vbo", True)
    imported = import_drive([tmp_path / "track.vbo"])
    assert imported.origin == "VBO"
    np.testing.assert_allclose(imported.drive.imu.t - start, T, atol=0.006)
    np.testing.assert_allclose(imported.drive.imu.specific_force, FORCE, atol=1e-6)
    np.testing.assert_allclose(imported.drive.imu.angular_rate, _resampled(RATE, TG), atol=1e-6)


# --- a drive by every format


def comma2k19(folder: Path) -> Path:
    """A segment: boot time, axes forward, right, down, the GNSS log in order of the README."""
    down, boot = np.array([1.0, -1.0, -1.0]), 77.0
    week, second = divmod(START + 18.0 - 315_964_800.0, 604_800.0)
    utc = (START + TL) * 1e3
    arrays = {
        "processed_log/IMU/accelerometer/t": boot + T,
        "processed_log/IMU/accelerometer/value": FORCE * down,
        "processed_log/IMU/gyro/t": boot + TG,
        "processed_log/IMU/gyro/value": RATE * down,
        "processed_log/GNSS/live_gnss_ublox/t": boot + TL + 0.2,
        "processed_log/GNSS/live_gnss_ublox/value": np.column_stack(
            [LATITUDE, LONGITUDE, SPEED, utc, ALTITUDE, BEARING]
        ),
        "global_pose/frame_times": boot + T,
        "global_pose/frame_gps_times": np.column_stack([np.full(T.size, week), second + T]),
    }
    for name, array in arrays.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with (folder / name).open("wb") as file:
            np.save(file, array)
    return folder


def mdf(path: Path) -> Path:
    """MDF4 with a mapping, whose path is returned."""
    asammdf = pytest.importorskip("asammdf")
    measurement = asammdf.MDF(version="4.10")
    measurement.header.start_time = datetime.fromtimestamp(START, tz=timezone.utc)
    place = {"lat": LATITUDE, "lon": LONGITUDE, "alt": ALTITUDE, "v": 3.6 * SPEED, "course": BEARING}
    groups = [
        (T, dict(zip(("ax", "ay", "az"), FORCE.T / G, strict=True))),
        (TG, dict(zip(("gx", "gy", "gz"), np.degrees(RATE).T, strict=True))),
        (TL, place),
    ]
    for stamps, channels in groups:
        signals = [asammdf.Signal(np.array(v), stamps, name=n) for n, v in channels.items()]
        measurement.append(signals, common_timebase=True)
    measurement.save(path)
    mapping = path.with_suffix(".yaml")
    mapping.write_text(
        "imu:\n  time: {}\n  specific_force: {columns: [ax, ay, az], unit: g}\n"
        "  angular_rate: {columns: [gx, gy, gz], unit: deg/s}\n"
        "fix: {time: {}, latitude: lat, longitude: lon, altitude: alt}\n"
        "vel: {time: {}, speed: v, bearing: course, unit: km/h}\n"
    )
    return mapping


#: Each writes the motion in a format below a folder and returns what is imported, and the mapping, if any.
Written = tuple[list[Path], Path | None]


def _one(write: Callable[[Path], Any], name: str) -> Callable[[Path], Written]:
    def written(folder: Path) -> Written:
        write(folder / name)
        return [folder / name], None

    return written


FORMATS: dict[str, Callable[[Path], Written]] = {
    "sensor_logger_android": _one(sensor_logger, "rec"),
    "sensor_logger_ios": _one(lambda p: sensor_logger(p, "ios"), "rec"),
    "sensor_logger_json": _one(lambda p: p.write_text(json.dumps(sensor_logger_json("ios"))), "rec.json"),
    "sensor_logger_sqlite": _one(lambda p: sensor_logger_database(p, "android"), "rec.sqlite"),
    "sensor_logger_combined": _one(sensor_logger_combined, "rec.csv"),
    "phyphox": _one(phyphox, "rec"),
    "phyphox_de": _one(lambda p: phyphox(p, ";", True, "de"), "rec"),
    "matlab_structs": _one(lambda p: scipy.io.savemat(p, _logs(TIMES["posix"])), "log.mat"),
    "matlab_arrays": _one(matlab_arrays, "log.mat"),
    "matlab_csv": _one(matlab_csv, "log"),
    "rtklib": lambda folder: ([sensor_logger(folder / "rec"), _pos(folder / "gnss.pos")], None),
    "rtklib_dms": lambda folder: ([sensor_logger(folder / "rec"), _pos(folder / "gnss.pos", dms=True)], None),
    "androsensor": _one(androsensor, "log.csv"),
    "sensorlog": _one(sensorlog, "log.csv"),
    "racechrono": _one(racechrono, "log.csv"),
    "physics_toolbox": _one(lambda p: physics_toolbox(p, True), "log.csv"),
    "physics_toolbox_times": _one(lambda p: physics_toolbox(p, False), "log.csv"),
    "vbo": _one(lambda p: vbo(p, True), "track.vbo"),
    "vbo_and_table": lambda folder: vbo_and_table(folder)[:2],
    "comma2k19": _one(comma2k19, "segment"),
    "mdf": lambda folder: ([folder / "bench.mf4"], mdf(folder / "bench.mf4")),
}


@pytest.fixture(scope="module")
def bump(repository: Path) -> tuple[Drive, Twin, dict[bool, float]]:
    """The bundled drive over a bump, its twin, and the gap of the two, by whether the receiver is accurate: where it
    says metres or nothing, as many formats do, the drive is placed by what was felt."""
    drive = read_drive(repository / "bags" / "bump_15kmh")
    twin = load_twin(repository / "bags" / "bump_15kmh" / "twin.yaml")
    fix = drive.fix
    silent = replace(fix, status=np.zeros_like(fix.status), sigma=np.full_like(fix.sigma, np.nan))
    gaps = (simulate_drive(d, twin).gap.rms for d in (replace(drive, fix=silent), drive))
    return drive, twin, dict(zip((False, True), gaps, strict=True))


@pytest.mark.long
@pytest.mark.parametrize("name", FORMATS)
def test_the_bundled_drive_has_the_same_gap_by_every_format(
    name: str, bump: tuple[Drive, Twin, dict[bool, float]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name in ("matlab_structs", "matlab_arrays") and sys.version_info < (3, 11):
        pytest.skip("no mat-io for Python 3.10")
    drive, twin, gaps = bump
    start, imu, fix = float(np.floor(drive.imu.t[0])), drive.imu, drive.fix
    t = np.round(imu.t - start, 3)  # as most apps write them
    # of formats with one table the place in the moment of a row: what an app takes from the row before is lost
    fixed = t[np.searchsorted(t, fix.t[:-1] - start)]
    place = np.column_stack([fix.latitude, fix.longitude, fix.altitude, drive.velocity.enu])
    latitude, longitude, altitude, east, north, _ = (np.interp(fixed, fix.t - start, v) for v in place.T)
    motion = {
        "START": start,
        "START_NS": int(start) * 10**9,
        "T": t,
        "TG": t,
        "TL": fixed,
        "FORCE": imu.specific_force,
        "LINEAR": imu.specific_force - [0.0, 0.0, G],
        "GRAVITY": np.tile([0.0, 0.0, G], (t.size, 1)),
        "RATE": imu.angular_rate,
        "LATITUDE": latitude,
        "LONGITUDE": longitude,
        "ALTITUDE": altitude,
        "SPEED": np.hypot(east, north),
        "BEARING": np.degrees(np.arctan2(east, north)) % 360.0,
        "ACCURACY": float(np.sqrt(2.0) * fix.sigma[0, 0]),
        "VERTICAL": float(fix.sigma[0, 2]),
        "QUALITY": [1] * fixed.size,
    }
    for key, value in motion.items():
        assert key in globals()
        monkeypatch.setitem(globals(), key, value)
    files, mapping = FORMATS[name](tmp_path)
    imported = import_drive(files, mapping=mapping).drive
    assert len(imported.imu) > 0.99 * len(imu) and len(imported.fix) > 0.9 * fixed.size
    gap = gaps[not is_open(observe(imported, twin))]
    assert simulate_drive(imported, twin).gap.rms == pytest.approx(gap, rel=0.01)
    write_drive(imported, tmp_path / "bag")
    assert simulate_drive(read_drive(tmp_path / "bag"), twin).gap.rms == pytest.approx(gap, rel=0.01)


# --- clocks, velocities, figures


def test_gps_time_and_leap_seconds() -> None:
    """IERS: GPS − UTC was 0 at first, 13 s in 2000, 18 s since 2017; the second before each step too."""
    for moment, ahead in (
        ("1980-06-01", 0),
        ("2000-06-01", 13),
        ("2016-12-31T23:59:59", 17),
        ("2017-01-01", 18),
        ("2025-07-08", 18),
    ):
        utc = iso_to_posix(moment)
        assert gps_to_posix(np.array([utc + ahead]))[0] == utc
    # GPS week 2012, second 404106.397 is in comma2k19's drive of 2018-08-02
    assert week_to_posix(np.array([2012.0]), np.array([404106.397]))[0] == pytest.approx(
        iso_to_posix("2018-08-02T16:14:48.397"), abs=1e-6
    )


def test_dates_and_times_as_programs_write_them() -> None:
    expected = iso_to_posix("2024-05-01T10:00:02.500")
    for text in (
        "2024-05-01 10:00:02.5",
        "2024-05-01T10:00:02.500Z",
        "2024/05/01 10:00:02,500",
        "01-May-2024 10:00:02.500",
        "05/01/2024 10:00:02.5 AM",
        "01.05.2024 10:00:02.5",
        "2024-05-01T12:00:02.5+02:00",
        "20240501T10:00:02.5Z",
        "2024-05-01 10:00:02:500",
        "2024-05-01 12:00:02.5 UTC+02:00",
        "2024-05-01 07:30:02.5 GMT-2:30",
        "2024-05-01 12:00:02.5 +0200",
        "2024-05-01 13:00:02.5 UTC+3",
        "05/01/2024, 10:00:02.5",
    ):
        assert text_to_posix([text])[0] == pytest.approx(expected, abs=1e-6), text
    assert np.isnan(text_to_posix(["", "noon", "2024-13-01 10:00:00", "10:00:00"])).all()
    assert text_to_posix(["05/01/2024 12:30:00 PM"])[0] - iso_to_posix("2024-05-01") == 12.5 * 3600


@pytest.mark.parametrize("separator", ["/", "-", "."])
def test_days_before_months_where_a_date_shows_it(separator: str) -> None:
    """One order for the whole column; without such a date a slash is American."""
    days = [f"{day:02}{separator}{month:02}{separator}2019 23:59:59" for day, month in ((12, 9), (13, 9))]
    assert np.diff(text_to_posix(days)) == 86400.0
    assert text_to_posix(days)[0] == iso_to_posix("2019-09-12T23:59:59")


def test_times_of_the_day_go_on_past_midnight() -> None:
    day = iso_to_posix("2019-09-13")
    texts = ["23:59:58.5", "23:59:59:250", "x", "00:00:00.0", "00:00:01"]
    found = text_to_posix(texts, day) - day - 86400
    np.testing.assert_allclose(found, [-1.5, -0.75, np.nan, 0.0, 1.0], atol=1e-6)


def test_velocities_from_speed_and_bearing() -> None:
    speed = np.array([1.0, 1.0, 1.0, 1.0, 0.1, -1.0, 5.0, 5.0, np.nan])
    bearing = np.array([0.0, 90.0, 180.0, 315.0, -1.0, 10.0, -1.0, np.nan, 10.0])
    velocity = velocities_from_course(np.arange(9.0), speed, bearing)
    assert velocity.t.tolist() == [0, 1, 2, 3, 4]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(
        velocity.enu[:4], [[0, 1, 0], [1, 0, 0], [0, -1, 0], [-half, half, 0]], atol=1e-15
    )
    assert np.linalg.norm(velocity.enu[4]) < 0.3


def test_velocities_from_positions_are_exact_on_parabolas_and_stop_at_gaps() -> None:
    import pymap3d

    t = np.concatenate([np.arange(20) * 0.25, 60 + np.arange(20) * 0.25]) + np.random.default_rng(0).uniform(
        0, 0.05, 40
    )
    east, north = 3 * t + 0.5 * t**2 * (t < 30), 2 * t
    latitude, longitude, altitude = pymap3d.enu2geodetic(east, north, 0 * t, 47.0, 19.0, 100.0)
    fix = FixData(
        START + t, latitude, longitude, altitude, np.zeros(40, dtype=np.int8), np.full((40, 3), np.nan)
    )
    velocity = velocities_from_fixes(fix)
    assert len(velocity) == 40
    np.testing.assert_allclose(
        velocity.enu[:, 0], 3 + t * (t < 30), atol=2e-3
    )  # the plane turns with the Earth
    np.testing.assert_allclose(velocity.enu[:, 1], 2.0, atol=2e-3)
    lost = FixData(fix.t, latitude, longitude, altitude, np.full(40, -1, dtype=np.int8), fix.sigma)
    assert len(velocities_from_fixes(lost)) == 0


def test_figures_of_a_drive(make: Callable[..., Any]) -> None:
    drive = make(1000)
    summary = summarise(drive)
    assert summary.imu.rate == pytest.approx(100, rel=1e-4)
    assert summary.imu.duration == pytest.approx(9.99)
    assert (summary.gravity.axis, summary.imu.gaps) == ("+z", ())
    t = np.concatenate([np.arange(100), 150 + np.arange(100)]) / 100
    rhythm = rhythm_of(t)
    assert [(round(a, 2), round(b, 2)) for a, b in rhythm.gaps] == [(0.99, 0.51)]
    for axis, column, sign in (("-z", 2, -1), ("+y", 1, 1), ("-x", 0, -1)):
        force = np.zeros((10, 3))
        force[:, column] = sign * G
        assert gravity_of(force).axis == axis
    text = "\n".join(summary.lines())
    for words in ("100.00 Hz", "+z", "no gaps", "km", "m/s"):
        assert words in text


# --- documentation


def test_every_importer_and_mapping_has_its_line_in_the_documentation(
    repository: Path, tmp_path: Path
) -> None:
    folder = repository / "config" / "import"
    text = (folder / "README.md").read_text(encoding="utf-8")
    for name in IMPORTERS:
        assert f"| `{name}` |" in text, name
        assert IMPORTERS[name].TITLE in text
    mappings = sorted(folder.glob("*.yaml"))
    assert mappings
    for path in mappings:
        assert f"| `{path.name}` |" in text, path.name
        load_mapping(path)
    example = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert example is not None
    (tmp_path / "my_drive.yaml").write_text(example.group(1), encoding="utf-8")
    assert load_mapping(tmp_path / "my_drive.yaml").name == "my_drive"
