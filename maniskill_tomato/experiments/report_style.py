"""Look of the report: the page around it and its style sheet."""

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<header><div><h1>{title}</h1><p>{subtitle}</p></div></header>
<main>
{body}
</main>
<footer>Written by maniskill-tomato {version}.</footer>
</body>
</html>
"""

STYLE = """
:root {
  --ink: #1f2a24; --muted: #5f6b64; --paper: #fafaf7; --card: #ffffff; --line: #e1e6e0;
  --tomato: #b8392a; --leaf: #2f6b42;
}
* { box-sizing: border-box; }
body {
  margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif;
}
header { background: var(--ink); color: #f4f6f2; border-bottom: 4px solid var(--tomato); }
header div, main, footer { max-width: 980px; margin: 0 auto; padding: 0 24px; }
header div { padding-top: 34px; padding-bottom: 28px; }
h1 { margin: 0; font-size: 30px; line-height: 1.2; letter-spacing: -0.01em; }
header p { margin: 8px 0 0; color: #c3cdc6; }
main { padding-bottom: 40px; }
section { margin-top: 38px; }
h2 { margin: 0 0 10px; font-size: 20px; }
p { margin: 0 0 14px; max-width: 70ch; }
a { color: var(--leaf); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(205px, 1fr)); gap: 14px; }
.tile {
  background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding: 16px 18px;
  display: flex; flex-direction: column;
}
.tile b { font-size: 34px; line-height: 1.1; font-variant-numeric: tabular-nums; }
.tile:first-child b { color: var(--leaf); }
.tile span { margin: 6px 0 8px; font-weight: 600; line-height: 1.35; }
.tile small { color: var(--muted); }
.notice {
  background: #fdf4e3; border: 1px solid #ecd9ae; border-left: 5px solid #d9a441; border-radius: 8px; padding:
  14px 18px;
}
figure {
  margin: 0 0 18px; background: var(--card); border: 1px solid var(--line); border-radius: 10px; padding:
  14px;
}
img, video { display: block; width: 100%; height: auto; border-radius: 6px; }
figcaption, .caption { color: var(--muted); font-size: 14px; margin: 10px 2px 0; }
.pairs { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 380px), 1fr)); gap: 0 16px; }
.scroll { overflow-x: auto; }
table {
  width: 100%; border-collapse: collapse; background: var(--card); border: 1px solid var(--line);
  font-variant-numeric: tabular-nums;
}
th, td { padding: 9px 14px; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
tbody th { text-align: left; font-weight: 500; white-space: normal; }
thead th { color: var(--muted); font-weight: 600; font-size: 14px; }
tbody tr:last-child > * { border-bottom: 0; }
dl { display: grid; grid-template-columns: minmax(130px, max-content) 1fr; gap: 6px 22px; margin: 0; }
dt { color: var(--muted); }
dd { margin: 0; overflow-wrap: anywhere; }
footer { padding-top: 18px; padding-bottom: 34px; color: var(--muted); font-size: 14px; }
@media (max-width: 560px) {
  h1 { font-size: 24px; }
  th, td { padding: 8px 8px; }
  dl { grid-template-columns: 1fr; gap: 0; }
  dd { margin-bottom: 10px; }
}
"""
