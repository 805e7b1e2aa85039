"""How the report looks, on screen and in print."""

CSS = """\
:root { --ink: #1a1a1a; --soft: #5c5c5c; --line: #dcdcdc; --accent: #0072b2; --warn: #b35900; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1160px; padding: 28px 28px 60px; color: var(--ink);
  background: #fff; font: 15px/1.5 "DejaVu Sans", Verdana, Helvetica, Arial, sans-serif; }
header { border-bottom: 3px solid var(--accent); margin-bottom: 22px; }
h1 { font-size: 26px; margin: 0; }
header p { margin: 4px 0 12px; color: var(--soft); }
h2 { font-size: 19px; margin: 34px 0 12px; }
h3 { font-size: 14px; margin: 0 0 4px; }
h3 small { font-weight: normal; color: var(--soft); }
.cards { display: grid; grid-template-columns: repeat(3, minmax(0, 1fr)); gap: 14px; }
.card { border: 1px solid var(--line); border-left: 4px solid var(--accent); border-radius: 4px;
  padding: 12px 14px; }
.card h3 { font-size: 13px; font-weight: normal; color: var(--soft); }
.card p { margin: 0; font-size: 13px; }
.card .value { font-size: 25px; font-weight: bold; margin: 2px 0 4px; }
.card.warning { border-left-color: var(--warn); }
.notes { margin: 0; padding-left: 20px; }
.grid { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 26px 30px; }
figure { margin: 0; break-inside: avoid; }
figure svg { display: block; width: 100%; height: auto; }
figure svg * { stroke-linejoin: round; stroke-linecap: butt; }
figure text { font-family: "DejaVu Sans", Verdana, sans-serif !important; }
figcaption, .legend { font-size: 12.5px; color: var(--soft); margin: 4px 0 0; }
figcaption.warning { color: var(--warn); }
.legend { margin-bottom: 14px; }
.wide { margin-bottom: 22px; }
.readout { display: none; }
.live .readout { display: block; min-height: 18px; margin: 2px 0 0; font-size: 12px; }
.readout span { display: inline-block; margin-right: 12px; font-variant-numeric: tabular-nums; }
.cursor { stroke: #1a1a1a; stroke-width: 0.8; stroke-opacity: 0.55; }
.whole { white-space: nowrap; }
#bar { display: flex; align-items: center;
  position: sticky; bottom: 0; margin-top: 26px; padding: 9px 12px; background: #fff;
  border: 1px solid var(--line); border-bottom: 0; font-size: 13px;
  box-shadow: 0 -2px 8px rgba(0, 0, 0, 0.08); }
#bar[hidden] { display: none; }
#bar label { flex: 0 0 55%; display: flex; align-items: center; }
#frame { flex: 1; margin: 0 12px; accent-color: var(--accent); }
#place { flex: 1; overflow: hidden; white-space: nowrap; text-overflow: ellipsis; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 5px 9px; border-bottom: 1px solid var(--line); text-align: left;
  vertical-align: top; }
thead th { border-bottom: 2px solid var(--ink); }
.numbers { width: 100%; }
.numbers th, .numbers td { text-align: right; padding: 5px 6px; }
.numbers th { font-size: 11.5px; vertical-align: bottom; }
small { font-weight: normal; color: var(--soft); }
details { margin-top: 18px; }
summary { cursor: pointer; margin-bottom: 6px; }
.keys td { overflow-wrap: anywhere; }
.keys th { white-space: nowrap; font-weight: normal; color: var(--soft); }
@media screen and (max-width: 760px) { .cards, .grid { grid-template-columns: 1fr; }
  .numbers { display: block; overflow-x: auto; } }
@media print { #bar, .live .readout, .cursor { display: none; }
  @page { size: A4; margin: 13mm; }
  body { padding: 0; max-width: none; font-size: 11px; }
  .cards { gap: 8px; } .card .value { font-size: 18px; } .card p, .card h3 { font-size: 10px; }
  h2 { font-size: 15px; margin-top: 18px; break-after: avoid; } h3 { font-size: 11px; }
  .grid { gap: 14px 16px; } figcaption, .legend { font-size: 9px; }
  table { font-size: 9px; } .numbers th { font-size: 8px; }
  .numbers th, .numbers td { padding: 3px; } tr, .card { break-inside: avoid; } }
"""

NOTEBOOK_CSS = """\
.tkamb .cards { display: flex; flex-wrap: wrap; gap: 10px; }
.tkamb .card { flex: 1 1 220px; border: 1px solid #dcdcdc; border-left: 4px solid #0072b2;
  padding: 8px 12px; }
.tkamb .card h3 { margin: 0; font-size: 12px; font-weight: normal; }
.tkamb .card p { margin: 0; font-size: 12px; }
.tkamb .card .value { font-size: 20px; font-weight: bold; }
.tkamb .card.warning { border-left-color: #b35900; }
"""
