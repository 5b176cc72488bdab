"""One drawing kit for notebooks, the report, figures and the dashboard.

The kit knows arrays, times and text, but no scan. Pillow writes PNG with one byte per pixel and a colour map;
unmeasured pixels are transparent. matplotlib takes a second to load and draws no page, so it draws only figures.
Charts of the dashboard are SVG from ECharts, whose colours are variables of the style sheet (light and dark). Scans are
not drawn by ECharts: they need the published values under the pointer.
"""
