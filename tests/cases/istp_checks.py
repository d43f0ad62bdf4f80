"""Checks of a CDF file by the ISTP guidelines of the Space Physics Data Facility."""

import re
from pathlib import Path

import cdflib
import numpy as np

#: Global attributes that the guide calls required, and those it recommends that a release states.
GLOBAL = (
    *("Project", "Source_name", "Discipline", "Data_type", "Descriptor", "Data_version"),
    *("Logical_file_id", "PI_name", "PI_affiliation", "TEXT", "Instrument_type", "Mission_group"),
    *("Logical_source", "Logical_source_description"),
    *("Rules_of_use", "Acknowledgement", "Generated_by", "Generation_date", "Parents", "MODS"),
)
#: Type of a CDF variable -> the fill value that ISTP gives it.
FILL = {
    "CDF_REAL4": np.float32(-1.0e31),
    "CDF_REAL8": -1.0e31,
    "CDF_DOUBLE": -1.0e31,
    "CDF_FLOAT": np.float32(-1.0e31),
    "CDF_INT8": -(2**63),
    "CDF_TIME_TT2000": -(2**63),
    "CDF_UINT1": 2**8 - 1,
    "CDF_UINT4": 2**32 - 1,
    "CDF_CHAR": " ",
}


def istp_findings(path: Path) -> list[str]:
    """Return what a file lacks; empty when it keeps the guidelines."""
    file = cdflib.CDF(path)
    told = file.globalattsget()
    findings = [f"{name} is missing" for name in GLOBAL if not any(map(str.strip, told.get(name, [""])))]
    names = file.cdf_info().zVariables
    if names[0] != "Epoch" or file.varinq("Epoch").Data_Type_Description != "CDF_TIME_TT2000":
        findings.append("the first variable is no Epoch in TT2000")
    source, stem = told.get("Logical_source", [""])[0], told.get("Logical_file_id", [""])[0]
    if stem != path.stem or not re.fullmatch(re.escape(source) + r"_\d{8}_v\d\d\.\d\d", path.stem):
        findings.append("the file's name is not Logical_source, day and version")
    parts = [
        told.get(key, [""])[0].partition(">")[0].lower() for key in ("Source_name", "Data_type", "Descriptor")
    ]
    if source != "_".join(parts):
        findings.append("Logical_source is not source, data type and descriptor")
    for name in names:
        findings += [f"{name}: {text}" for text in _of_variable(file, name, names)]
    return findings


def _of_variable(file: cdflib.CDF, name: str, names: list[str]) -> list[str]:
    told, about = file.varattsget(name), file.varinq(name)
    kind, numeric = about.Data_Type_Description, about.Data_Type_Description != "CDF_CHAR"
    findings = [f"{key} is empty" for key, value in told.items() if isinstance(value, str) and value == ""]
    needed = ["CATDESC", "FIELDNAM", "VAR_TYPE", "FILLVAL", "FORMAT"]
    needed += ["UNITS", "VALIDMIN", "VALIDMAX", "SCALETYP"] if numeric else []
    in_time = about.Rec_Vary and name != "Epoch"
    needed += ["DEPEND_0", "DISPLAY_TYPE"] if in_time else []
    needed += ["LABL_PTR_1"] if numeric and len(about.Dim_Sizes) == 1 else []
    needed += ["LABLAXIS"] if numeric and not about.Dim_Sizes else []
    findings += [f"{key} is missing" for key in needed if key not in told]
    if findings:
        return findings
    if told["FIELDNAM"] != name:
        findings.append("FIELDNAM is not its name")
    if told["VAR_TYPE"] not in {"data", "support_data", "metadata"}:
        findings.append("VAR_TYPE is none of ISTP's")
    if told["FILLVAL"] != FILL[kind]:
        findings.append(f"FILLVAL {told['FILLVAL']} is not that of {kind}")
    pointers = [
        told[key] for key in ("DEPEND_0", "LABL_PTR_1", "DELTA_PLUS_VAR", "DELTA_MINUS_VAR") if key in told
    ]
    findings += [f"points to {target}, which is not there" for target in pointers if target not in names]
    if numeric:
        values = np.asarray(file.varget(name))
        valid = values[values != told["FILLVAL"]]
        if valid.size and (valid.min() < told["VALIDMIN"] or valid.max() > told["VALIDMAX"]):
            findings.append("values lie outside VALIDMIN and VALIDMAX")
    if "LABL_PTR_1" in told and file.varinq(told["LABL_PTR_1"]).Dim_Sizes != about.Dim_Sizes:
        findings.append("the labels are not as many as the components")
    if in_time and file.varinq("Epoch").Last_Rec != about.Last_Rec:
        findings.append("it has not as many records as Epoch")
    return findings
