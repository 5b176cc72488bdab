"""The style sheet of the report."""

from __future__ import annotations

from afspm.drawing import timeline

# P. Tol's bright scheme: told apart by everybody, red kept for problems
CSS = (
    timeline.CSS
    + """
:root{--lane:var(--panel);--quiet:var(--soft)}
:root{--paper:#fff;--ink:#1b1b1b;--soft:#666;--rule:#ddd;--panel:#f5f5f5;--state:#888;--problem:#c9304a;
--manual:#d9a400;--c0:#4477aa;--c1:#228833;--c2:#aa3377;--c3:#3a9fc0;--c4:#9a8a1c;color-scheme:light dark}
@media(prefers-color-scheme:dark){:root{--paper:#16181b;--ink:#e8e8e8;--soft:#a0a0a0;--rule:#34383d;--panel:#1f2327;
--state:#8a8f96;--problem:#ff6b81;--manual:#f0c040;--c0:#79a8dc;--c1:#5cbf6c;--c2:#e07ab8;--c3:#7fd0ea;--c4:#d6c65a}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:15px/1.45 system-ui,sans-serif}
main{max-width:1080px;margin:0 auto;padding:1.2rem}
h1{font-size:1.7rem;margin:.2rem 0}h2{font-size:1.15rem;margin:2rem 0 .6rem;border-bottom:1px solid var(--rule)}
header p,.note,footer,figcaption,small{color:var(--soft)}
.badge{margin-left:.8rem;padding:.1rem .5rem;border-radius:.3rem;background:var(--problem);color:var(--paper);
font-size:.9rem;vertical-align:middle;letter-spacing:.08em}
.lead{font-size:1.05rem}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(9rem,1fr));gap:.6rem}
.card{background:var(--panel);border-radius:.5rem;padding:.7rem .9rem;display:flex;flex-direction:column}
.card b{font-size:1.6rem;line-height:1.2}
.lanes{min-width:640px}.lane span.state{background:var(--state)}.lane span.problem{background:var(--problem)}
.lane span.manual{background:var(--manual)}.lane span.c0{background:var(--c0)}.lane span.c1{background:var(--c1)}
.lane span.c2{background:var(--c2)}.lane span.c3{background:var(--c3)}.lane span.c4{background:var(--c4)}
rect.state{fill:var(--state)}rect.problem{fill:var(--problem)}rect.manual{fill:var(--manual)}
rect.c0{fill:var(--c0)}rect.c1{fill:var(--c1)}rect.c2{fill:var(--c2)}rect.c3{fill:var(--c3)}rect.c4{fill:var(--c4)}
i{display:block;height:4px;margin-top:2px}i.state{background:var(--state)}i.c0{background:var(--c0)}
i.c1{background:var(--c1)}i.c2{background:var(--c2)}i.c3{background:var(--c3)}i.c4{background:var(--c4)}
.shares{display:grid;grid-template-columns:repeat(auto-fit,minmax(20rem,1fr));gap:1rem}
.share{width:100%;min-width:3.5rem;height:10px;background:var(--panel);display:block}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%}th{text-align:left;font-weight:600;color:var(--soft)}
td,th{padding:.25rem .6rem .25rem 0;border-bottom:1px solid var(--rule);vertical-align:top;
font-variant-numeric:tabular-nums}
.shares td:nth-child(n+3){white-space:nowrap}.shares td:nth-child(2){width:40%}
.sheet{display:grid;grid-template-columns:repeat(auto-fill,minmax(92px,1fr));gap:.6rem;align-items:start}
.sheet figure{margin:0;break-inside:avoid}.sheet img{width:100%;display:block;image-rendering:pixelated}
.sheet figcaption{font-size:.72rem;line-height:1.25}.sheet figcaption b{color:var(--problem)}
.bad img,.bad .none{outline:2px solid var(--problem)}
.none{aspect-ratio:1;background:var(--panel);color:var(--soft);display:grid;place-items:center;font-size:.75rem}
.figure{margin:1rem 0;break-inside:avoid}.figure img{max-width:100%;background:#fff;padding:.4rem;border-radius:.4rem}
footer{margin-top:2rem;font-size:.85rem}
@media print{main{max-width:none;padding:0}section{break-inside:auto}h2{break-after:avoid}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""
)
