"""One drawing kit for notebooks, the report, figures and the dashboard.

The kit knows arrays, times and text, but no scan. Pillow writes PNG with one byte per pixel and a colour map;
unmeasured pixels are transparent. matplotlib takes a second to load and draws no page, so it draws only figures.
Charts of the dashboard are SVG from ECharts, whose colours are variables of the style sheet (light and dark). Scans are
not drawn by ECharts: they need the published values under the pointer.

One convention, since two scans side by side once had colours that meant different heights. Lines are levelled by
`model.line_levelling`. The colour map ends at the 1st and 99th percentile (`raster.value_range`). Compared images share
one range: scans of one size and unit the range of all their values together (`pooled_range`), which one bad scan does
not widen; scans of another size are not compared, so that a flat zoom beside a steep overview keeps its contrast.
Unmeasured values are grey or transparent, axes are labelled "name / unit", times of day have ticks at round times.

A component has two colours: the page colours it by its name, before it knows the others, and a report by its place in
the list, so that no two are alike.
"""
