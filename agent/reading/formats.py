"""The table of formats. A new format is one file and one line here."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from agent.config.files import open_file
from agent.reading.ground_motion import GroundMotion, Role
from agent.reading.seismic import MiniSeed
from agent.reading.source import Source, TableError
from agent.reading.stationxml import read_stationxml


@dataclass(frozen=True, slots=True)
class Format:
    """A format: its name, how a file of it ends and begins, and the function that opens it.

    `begins`: regular expressions of the first bytes of every such file. `opens`: "module:function".
    `extra`: the extra of fieldcal that has the libraries, "" where none is needed.
    """

    name: str
    suffixes: tuple[str, ...]
    begins: tuple[bytes, ...]
    opens: str
    extra: str = ""


IDE_BEGINS = rb"(?s)\x1aE\xdf\xa3.{0,60}mide"  # EBML, and the type of the document
# A number of six digits and a letter (version 2, and SEED), or MS (version 3).
MINISEED_BEGINS = (rb"\d{6}[DRQMV][ \x00]", rb"MS\x03")
# A zip archive of which the first part is one of a workbook.
XLSX_BEGINS = rb"(?s)PK\x03\x04.{26}(\[Content_Types\]\.xml|_rels/|docProps/|xl/)"
MINISEED = "agent.reading.seismic:open_miniseed"
FORMATS = (
    Format("MCAP", (".mcap",), (rb"\x89MCAP0\r\n",), "agent.reading.recording:open_mcap"),
    Format("SQLite", (".db3",), (rb"SQLite format 3\x00",), "agent.reading.ros2:RosBag"),
    Format("ROS 1", (".bag",), (rb"#ROSBAG V",), "agent.reading.ros2:RosBag"),
    Format("Parquet", (".parquet",), (b"PAR1",), "agent.reading.arrow:Parquet", "files"),
    Format("Feather", (".feather", ".arrow"), (b"ARROW1",), "agent.reading.arrow:Feather", "files"),
    Format("WAV", (".wav",), (b"RIFF", b"RF64"), "agent.reading.wav:open_wav"),
    Format("HDF5", (".h5", ".hdf5"), (rb"\x89HDF\r\n\x1a\n",), "agent.reading.hdf5:open_hdf5", "hdf5"),
    Format("MATLAB", (".mat",), (rb"MATLAB 5\.0",), "agent.reading.matlab:open_matlab"),
    Format("MATLAB 7.3", (".mat",), (rb"MATLAB 7\.3",), "agent.reading.hdf5:open_hdf5", "hdf5"),
    Format("MiniSEED", (".mseed", ".miniseed", ".msd"), MINISEED_BEGINS, MINISEED, "seismic"),
    Format("IDE", (".ide",), (IDE_BEGINS,), "agent.reading.ide:open_ide", "endaq"),
    Format("Excel", (".xlsx", ".xlsm"), (XLSX_BEGINS,), "agent.reading.xlsx:open_xlsx", "files"),
    Format("TDMS", (".tdms",), (b"TDSm",), "agent.reading.tdms:open_tdms", "tdms"),
)
BAGS = FORMATS[:3]
FIELDS = rb"[^\s,=]+=[^\s,=]+(?:,[^\s,=]+=[^\s,=]+)*"
# The measurement with its tags, the fields, and the time in ns; comments before it.
LINE_PROTOCOL = rb"(?:#[^\n]*\n)*[^\s,=#]+(?:," + FIELDS + rb")? " + FIELDS + rb" -?\d{9,20}\r?\n"
ONE_CHANNEL = "its lines hold one channel: write time, x, y and z as columns of a CSV"
FIRST_PART = rb"(?s)PK\x03\x04.{26}"  # of a zip archive; its name follows
# What is not read: how such a file begins, what it is, and what to do with it.
NOT_READ = (
    (rb'"?TOB[123]"?[,\s]', "TOB, the binary format of Campbell Scientific", "convert it to TOA5 (CardConvert)"),
    (FIRST_PART + rb"[^\x00/]{1,200}\.npy", "an archive of NumPy (.npz)", "write the arrays as columns of a CSV"),
    (FIRST_PART + rb"mimetypeapplication/vnd\.oasis", "a document of LibreOffice (.ods)", "write it as .xlsx or CSV"),
    (
        FIRST_PART + rb"(?:info\.txt|log\.bin|activity\.bin)",
        "a file of ActiGraph (.gt3x)",
        "write it as CSV (ActiLife)",
    ),
    (rb"\x93NUMPY", "an array of NumPy (.npy)", "write it as columns of a CSV"),
    (rb"\x1f\x8b|BZh|\xfd7zXZ\x00|\x28\xb5\x2f\xfd|PK\x03\x04|7z\xbc\xaf", "a compressed file", "unpack it"),
    (rb"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", "a file of Office before 2007", "write it as .xlsx or CSV"),
    (rb"\xff\xfe\x00\x00|\x00\x00\xfe\xff", "text in UTF-32", "write it in UTF-8"),
    (rb'(?:\xef\xbb\xbf)?\s*(?:\{\s*["}]|\[\s*[\[{])', "JSON", "write it as CSV"),
    (rb" {0,4}-1 *\r?\n +\d+", "UFF58, the universal file format", "write it as CSV"),
    (rb"TIMESERIES \S+,", "the text of a seismic archive (SLIST or TSPAIR)", "fetch the same data as MiniSEED"),
    (rb"Origin Time +\d", "a record of K-NET or KiK-net", ONE_CHANNEL),
    (
        LINE_PROTOCOL,
        "the line protocol of InfluxDB",
        "write a CSV with a column for each field (`influx -format csv`, or in Flux `|> pivot(...)`)",
    ),
    (rb"PEER ", "a record of PEER (AT2)", ONE_CHANNEL),
    (rb"(?:Uncorrected|Corrected) [^\n]{0,40}\(Format v", "a record in the format of COSMOS", ONE_CHANNEL),
    (rb"EVENT_NAME: ", "a record of ESM or ITACA (DYNA)", ONE_CHANNEL),
    (rb"(?:\xef\xbb\xbf)?\s*<(?:\?xml|!DOCTYPE|html)", "XML or HTML", "write it as CSV"),
)
TEXT = Format("CSV", (".csv", ".tsv", ".txt", ".dat"), (), "agent.reading.delimited:Delimited")
LONGEST_BEGIN = 1024


@dataclass(frozen=True, slots=True)
class Description:
    """What describes a file: the StationXML of a MiniSEED file, the mapping of a recording of ROS 2, and the order of
    day, month and year in the dates of a text ("dmy", "mdy" or "ymd")."""

    metadata: Path | None = None
    mapping: Path | None = None
    date_order: str | None = None


NOT_DESCRIBED = Description()


def open_source(path: Path, described: Description = NOT_DESCRIBED, role: Role = "sensor") -> Source:
    """Open a file in any of the formats; a file that begins like none of them is read as text.

    `role`: as what a MiniSEED file with metadata is read. Raises TableError.
    """
    try:
        with open_file(path) as file:
            begin = file.read(LONGEST_BEGIN)
    except OSError as error:
        raise TableError(f"{path}: {error.strerror}") from None
    form = format_of(path, begin)
    if form is TEXT:
        _refuse_unread(path, begin)
    module, _, name = form.opens.partition(":")
    opened: Callable[..., Source] = getattr(importlib.import_module(module), name)
    if described.metadata is not None and form.name != "MiniSEED":
        raise TableError(f"{described.metadata}: it describes MiniSEED, but {path} is {form.name}; leave it out")
    try:
        if described.mapping is not None and form in BAGS:
            from agent.reading.mapping import read_mapping
            from agent.reading.ros2 import RosBag

            return RosBag(path, read_mapping(described.mapping))
        source = opened(path, described.date_order or "") if form is TEXT else opened(path)
        if described.metadata is not None and isinstance(source, MiniSeed):
            return GroundMotion(source, read_stationxml(described.metadata), role)
        return source
    except ImportError as error:
        raise TableError(
            f"{path}: {form.name} files need {error.name}, which is not installed: "
            f"fieldcal extras --install {form.extra}"
        ) from None


def _refuse_unread(path: Path, begin: bytes) -> None:
    for first, what, remedy in NOT_READ:
        if re.match(first, begin):
            raise TableError(f"{path}: it is {what}, which is not read; {remedy}")


def format_of(path: Path, begin: bytes) -> Format:
    """The format of a file that begins with these bytes; for one that no format knows, and that is no text, by its
    name: MATLAB 4 has no sure begin."""
    for form in FORMATS:
        if any(re.match(first, begin) for first in form.begins):
            return form
    suffix, is_text = path.suffix.lower(), b"\x00" not in begin
    return TEXT if is_text else next((form for form in FORMATS if suffix in form.suffixes), TEXT)
