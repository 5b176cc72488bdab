"""Detection of tip changes from the lines of running scans.

**Theory of operation.** Each line is compared with an earlier scan of the same place. The unexplained differences are
summed up; a sum above the sums of good scans raises an alarm.

    comes in      lines of running scans, complete scans, verdicts on these, the feedback, flags
    state         for each kind of scan: the usual difference of good scans (saved), and the newest of them (not saved)
    goes out      a `TipVerdict` with the row; the flag `tip-shape-changed`
    always holds  nothing is learnt from a scan with an alarm, a flagged problem, a changed feedback or a bad verdict

`registration` finds the shift of single lines, and `line_judge` decides. `causes` explains differences without the tip,
and `disturbances` finds noise and streaks. All of these are pure. `line_watch` is the component.
"""
