"""A watch on running scans: sees in their lines that the tip has changed.

**Theory of operation.** Each line is compared with an earlier scan of the same place. What that scan does not explain
is summed, and a sum above what good scans reach is an alarm.

    comes in      lines of running scans, complete scans, verdicts on these, the feedback, flags
    state         for each kind of scan: the usual difference of good scans (saved), and the newest of them (not saved)
    goes out      a `TipVerdict` with the row; the flag `tip-shape-changed`
    always holds  nothing is learnt from a scan with an alarm, under a flag, with a changed feedback, or called bad

`registration` finds the shift of single lines, `line_judge` decides; both are pure. `line_watch` is the component.
"""
