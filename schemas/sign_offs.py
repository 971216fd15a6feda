"""Table `sign_offs`: states that a person approved for loading. Rows are added and never changed."""

from __future__ import annotations

from schemas.columns import Recorded, TableSchema, column, row

__all__ = ["SIGN_OFFS", "SignOff"]


@row(eq=True)
class SignOff(Recorded):
    """One row of `sign_offs`; fields are the columns of the same name."""

    vehicle: str = column("vehicle id")
    day: str = column("last day of the state's window, YYYY-MM-DD")
    method: str = column("method of the state")
    state_key: str = column("work key of the state's rows")
    signed_by: str = column("person who approved it")
    note: str = column("for people", default="")


SIGN_OFFS = TableSchema(
    SignOff,
    "sign_offs",
    1,
    "The last row of a vehicle and method names the approved state; a roll-back is another row.",
    made_by="state",
    about=("vehicle", "day", "method"),
)
