"""LabVIEW measurement files: sections, units, and one, several or no columns of time stamps."""

from pathlib import Path

import numpy as np
import pytest

from fitting.logs.raw_table import RawTable
from fitting.logs.read_table import read_table

COUNT = 12
TIME = np.arange(COUNT) * 1e-3
A, B = np.random.default_rng(0).normal(size=(2, COUNT))


def lvm(folder: Path, *, columns: str, decimal: str, comment: bool = True, sections: int = 1) -> RawTable:
    head = [
        "LabVIEW Measurement\t",
        "Writer_Version\t2",
        "Separator\tTab",
        f"Decimal_Separator\t{decimal}",
        f"X_Columns\t{columns}",
        "Date\t2024/05/02",
        f"Time\t14:03:11{decimal}5231",
        "***End_of_Header***\t",
        "\t",
    ]
    names = {"One": ["X_Value", "A", "B"], "Multi": ["X_Value", "A", "X_Value", "B"], "No": ["X_Value", "A", "B"]}
    lines = [*head]
    for part in np.array_split(np.arange(COUNT), sections):
        lines += ["Channels\t2\t", f"Samples\t{len(part)}\t{len(part)}", "Y_Unit_Label\tdeg\tN m"]
        lines += [f"Delta_X\t0{decimal}001\t0{decimal}001", "***End_of_Header***\t\t"]
        lines.append("\t".join([*names[columns], *(["Comment"] if comment else [])]))
        for i in part:
            cells = {"One": [TIME[i], A[i], B[i]], "Multi": [TIME[i], A[i], TIME[i], B[i]], "No": ["", A[i], B[i]]}
            row = [c if isinstance(c, str) else repr(float(c)).replace(".", decimal) for c in cells[columns]]
            lines.append("\t".join([*row, *(["first"] if comment and i == 0 else [])]))
    path = folder / "log.lvm"
    path.write_bytes("\r\n".join(lines).encode("latin-1"))
    return read_table(path, ("X_Value", "X_Value (2)", "A", "B"))


@pytest.mark.parametrize("decimal", [".", ","])
@pytest.mark.parametrize("comment", [False, True])
@pytest.mark.parametrize("columns", ["One", "Multi", "No"])
@pytest.mark.parametrize("sections", [1, 3])
def test_lvm_table_is_read_with_units_and_time_stamps(
    tmp_path: Path, columns: str, decimal: str, comment: bool, sections: int
):
    table = lvm(tmp_path, columns=columns, decimal=decimal, comment=comment, sections=sections)
    np.testing.assert_array_equal(table.columns["A"].values, A)
    np.testing.assert_array_equal(table.columns["B"].values, B)
    assert (table.columns["A"].unit, table.columns["B"].unit) == ("deg", "N m")
    if columns == "No":
        assert table.sample_rate == pytest.approx(1000.0)
    else:
        assert table.sample_rate is None and table.columns["X_Value"].unit == "s"
        np.testing.assert_array_equal(table.columns["X_Value"].values, TIME)
    assert ("X_Value (2)" in table.columns) == (columns == "Multi")
