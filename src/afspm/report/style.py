"""The style sheet of the report, for light and dark, narrow and wide screens, and paper."""

from afspm.drawing import timeline

# P. Tol's bright scheme, safe for colour-blind readers; red is reserved for problems
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
h1{font-size:1.7rem;margin:.2rem 0;display:flex;flex-wrap:wrap;gap:.2rem .8rem;align-items:center}
h1{overflow-wrap:anywhere}
h2{font-size:1.15rem;margin:2rem 0 .6rem;border-bottom:1px solid var(--rule)}
h3{font-size:1rem;margin:1.2rem 0 .4rem}
header p,.note,footer,figcaption,small{color:var(--soft)}header p{margin:.3rem 0}
td small{display:block;font-size:.75rem;line-height:1.2}
.badge{padding:.1rem .5rem;border-radius:.3rem;background:var(--problem);color:var(--paper);
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
.shares{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(20rem,100%),1fr));gap:1rem}
.share{width:100%;min-width:3.5rem;height:10px;background:var(--panel);display:block}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%}th{text-align:left;font-weight:600;color:var(--soft)}
td,th{padding:.25rem .6rem .25rem 0;border-bottom:1px solid var(--rule);vertical-align:top;
font-variant-numeric:tabular-nums}
details>summary{cursor:pointer}details table{width:auto;margin:.2rem 0 .4rem}
.text{white-space:pre-wrap;overflow-wrap:anywhere}
.shares td:nth-child(n+3){white-space:nowrap}.shares td:nth-child(2){width:40%}
.map{position:relative;max-width:560px;margin:0 0 1.6rem 3.2rem;background:var(--panel);outline:1px solid var(--rule)}
.map>a{position:absolute;outline:1px solid var(--soft)}.map>a:hover{outline:2px solid var(--c0);z-index:1}
.map>a.bad{outline-color:var(--problem)}.map img{width:100%;height:100%;display:block}
.map>b{position:absolute;width:9px;height:9px;margin:-4.5px 0 0 -4.5px;border-radius:50%;background:var(--c3);
border:1.5px solid #fff;outline:1px solid #000}
.map>u{position:absolute;transform:translate(-50%,-50%);text-decoration:none;font:bold 17px/1 system-ui,sans-serif;
color:#c9304a;text-shadow:0 0 2px #fff,0 0 2px #fff,0 0 2px #fff}
.map>s{position:absolute;text-decoration:none;font-size:11.5px;color:var(--soft);white-space:nowrap}
.map>s.x{top:100%;transform:translate(-50%,3px)}.map>s.y{right:100%;transform:translate(-5px,-50%)}
.sheet{display:grid;grid-template-columns:repeat(auto-fill,minmax(104px,1fr));gap:.7rem;align-items:start}
.sheet figure{margin:0;break-inside:avoid;scroll-margin-top:35vh;min-width:0}
.sheet figcaption{font-size:.72rem;line-height:1.3}.sheet figcaption b{color:var(--problem)}
.sheet .open{display:block;position:relative;color:inherit;text-decoration:none}
.sheet img{width:100%;display:block;image-rendering:pixelated}
.sheet .open svg{width:100%!important;background:var(--panel)}
.change{position:absolute;left:0;right:0;margin:0;border:0;height:2px;
background:repeating-linear-gradient(90deg,#fff 0 5px,#000 5px 9px)}
.bad .open{outline:2px solid var(--problem)}
.none{aspect-ratio:1;background:var(--panel);color:var(--soft);display:grid;place-items:center;font-size:.75rem}
.wide{grid-template-columns:repeat(auto-fill,minmax(min(240px,100%),1fr))}
.wide img{image-rendering:auto;background:#fff}
.charts{display:flex;flex-wrap:wrap;gap:.6rem}
.more,.scan:not(:target) .open span{display:none}
figure:not(:target) .chart text{display:none}.charts .chart text{display:block!important}
figure:target .view{position:fixed;inset:0;z-index:9;overflow:auto;padding:1rem;background:var(--paper);display:flex;
flex-wrap:wrap;gap:1.2rem;align-content:center;justify-content:center;align-items:center}
figure:target .open{pointer-events:none;outline:0}figure:target .more{display:block;position:relative;max-width:26rem}
figure:target .open svg{background:none}
.scan:target .open{width:min(82vh,100%,calc(var(--ratio)*82vh))}
.wide figure:target .open{width:min(1100px,100%)}.wide figure:target img{max-height:88vh;object-fit:contain}
.curves:target .open{width:min(640px,100%)}
.more dl{display:grid;grid-template-columns:auto 1fr;gap:.15rem .8rem;margin:.6rem 0}.more dt{color:var(--soft)}
.more dd{margin:0;overflow-wrap:anywhere}
.steps{display:flex;gap:.5rem;position:relative;z-index:2}
.steps a{padding:.3rem .8rem;border:1px solid var(--rule);border-radius:.4rem;color:var(--ink);text-decoration:none}
.steps a:hover{background:var(--panel)}
.back{position:absolute;inset:0}
footer{margin-top:2rem;font-size:.85rem}
@media print{main{max-width:none;padding:0}section{break-inside:auto}h2{break-after:avoid}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}}
"""
)
