"""How the page looks and zooms: light and dark, from 400 pixels on, and nothing fetched from elsewhere."""

CSS = """
:root{color-scheme:light dark;--ink:#1b1f24;--soft:#59636e;--paper:#fff;--card:#f6f8fa;--edge:#d1d9e0;
--measured:#1b1f24;--nominal:#cf222e;--repaired:#0969da;--best:#1a7f37;--trace:#9a6700}
@media(prefers-color-scheme:dark){:root{--ink:#e6edf3;--soft:#9198a1;--paper:#0d1117;--card:#151b23;--edge:#3d444d;
--measured:#e6edf3;--nominal:#ff7b72;--repaired:#58a6ff;--best:#3fb950;--trace:#d29922}}
*{box-sizing:border-box}
body{font:16px/1.5 system-ui,sans-serif;color:var(--ink);background:var(--paper);margin:0}
main{max-width:68rem;margin:0 auto;padding:1.5rem 1rem 4rem}
h1{font-size:1.55rem;line-height:1.25;margin:.2rem 0 .6rem}h2{font-size:1.1rem;margin:2.2rem 0 .3rem}
p{margin:.3rem 0 .7rem;max-width:46rem}.soft,figcaption{color:var(--soft);font-size:.88rem}
.tag{display:inline-block;font-size:.8rem;padding:.1rem .55rem;border:1px solid var(--edge);border-radius:1rem}
figure{margin:.8rem 0;background:var(--card);border:1px solid var(--edge);border-radius:.5rem;padding:.6rem}
.pair{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,19rem),1fr));gap:.6rem}
.pair svg{max-width:38rem}
figure{overflow-x:auto}svg{display:block;width:100%;height:auto}figure>svg{min-width:36rem}
text{fill:var(--soft);font:11.5px system-ui,sans-serif}
.grid{stroke:var(--edge);stroke-width:.6;fill:none}.line{fill:none;stroke-width:1.3;vector-effect:non-scaling-stroke}
.dots{fill:none;stroke-width:2.4;stroke-linecap:round;stroke-opacity:.5;vector-effect:non-scaling-stroke}
.few{stroke-width:5;stroke-opacity:.8}
.measured{stroke:var(--measured)}.nominal{stroke:var(--nominal)}.repaired{stroke:var(--repaired)}
.bar{stroke:none;fill:var(--soft);fill-opacity:.55}.bar.best{fill:var(--best);fill-opacity:.85}
.bar.nominal{fill:var(--nominal);fill-opacity:.85}.bar.trace{fill:var(--trace);fill-opacity:.85}
.whisker{stroke:var(--ink);stroke-width:1.4;fill:none}
svg[data-zoom]{cursor:ew-resize;touch-action:pan-y}.band{fill:var(--repaired);fill-opacity:.18}
.key{margin-right:1.1rem;white-space:nowrap;font-size:.85rem;color:var(--soft)}
.key:before{content:"";display:inline-block;width:1.4rem;height:0;border-top:.2rem solid;vertical-align:middle;
margin-right:.35rem}
.key.measured:before{color:var(--measured)}.key.nominal:before{color:var(--nominal)}
.key.repaired:before{color:var(--repaired)}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.9rem;width:100%}
th,td{text-align:left;padding:.25rem .8rem .25rem 0;border-bottom:1px solid var(--edge);vertical-align:top}
th{color:var(--soft);font-weight:600}
pre{font:13px/1.45 ui-monospace,monospace;background:var(--card);border:1px solid var(--edge);border-radius:.5rem;
padding:.7rem;overflow-x:auto;margin:.4rem 0}
.add{color:var(--best)}.cut{color:var(--nominal)}
button{font:inherit;font-size:.8rem;color:inherit;background:var(--card);border:1px solid var(--edge);
border-radius:.4rem;padding:.1rem .6rem;cursor:pointer}
.next{border-left:.25rem solid var(--repaired);padding:.2rem .8rem;margin:1rem 0}
"""

SCRIPT = """
for (const svg of document.querySelectorAll('svg[data-zoom]')) {
  const [x0, x1, left, right] = svg.dataset.zoom.split(' ').map(Number);
  const plot = svg.querySelector('.plot'), names = svg.querySelectorAll('.names .x'), grid = svg.querySelector('.grid');
  const still = grid.getAttribute('d'), places = [...names].map(n => [n.getAttribute('x'), n.textContent]);
  const NS = 'http://www.w3.org/2000/svg', band = document.createElementNS(NS, 'rect');
  band.setAttribute('class', 'band'); band.setAttribute('y', 10); band.setAttribute('width', 0);
  band.setAttribute('height', svg.viewBox.baseVal.height - 48); svg.append(band);
  let from = null, low = x0, high = x1;
  const at = e => {
    const box = svg.getBoundingClientRect();
    const px = (e.clientX - box.left) / box.width * svg.viewBox.baseVal.width;
    return Math.min(right, Math.max(left, px));
  };
  const show = () => {
    const whole = right - left, scale = (x1 - x0) / (high - low);
    const shift = left - (left + (low - x0) / (x1 - x0) * whole) * scale;
    plot.setAttribute('transform', `translate(${shift} 0) scale(${scale} 1)`);
    grid.setAttribute('d', scale === 1 ? still : still.replace(/M[^M]*V[^M]*/g, ''));
    names.forEach((n, i) => {
      const part = (i + .5) / names.length;
      n.setAttribute('x', scale === 1 ? places[i][0] : left + part * whole);
      n.textContent = scale === 1 ? places[i][1] : Number((low + part * (high - low)).toPrecision(4));
    });
  };
  svg.addEventListener('pointerdown', e => { from = at(e); if (e.isTrusted) svg.setPointerCapture(e.pointerId); });
  svg.addEventListener('pointermove', e => {
    if (from === null) return;
    band.setAttribute('x', Math.min(from, at(e))); band.setAttribute('width', Math.abs(at(e) - from));
  });
  svg.addEventListener('pointerup', e => {
    if (from === null) return;
    const a = Math.min(from, at(e)), b = Math.max(from, at(e)), unit = (high - low) / (right - left);
    from = null; band.setAttribute('width', 0);
    if (b - a > 6) { [low, high] = [low + (a - left) * unit, low + (b - left) * unit]; show(); }
  });
  svg.addEventListener('dblclick', () => { [low, high] = [x0, x1]; show(); });
}
for (const button of document.querySelectorAll('button[data-copy]')) {
  button.addEventListener('click', () => {
    const pre = document.getElementById(button.dataset.copy), range = document.createRange();
    range.selectNodeContents(pre); getSelection().removeAllRanges(); getSelection().addRange(range);
    if (navigator.clipboard) navigator.clipboard.writeText(pre.textContent).then(
      () => { button.textContent = 'copied'; }, () => { button.textContent = 'selected: Ctrl-C'; });
    else button.textContent = 'selected: Ctrl-C';
  });
}
"""
