// ---- curves over an axis ---------------------------------------------------------------------------------------
const signed = (text) => text.replace("-", "−");
// a colour of a light page, nearer to white on a dark one
function tint(hex) {
  const part = dark.matches ? 0.45 : 0;
  return `rgb(${[1, 3, 5].map((at) => { const value = parseInt(hex.slice(at, at + 2), 16); return Math.round(value + part * (255 - value)); }).join(",")})`;
}
function ticks(low, high, log) {
  if (log) {
    const found = [], steps = high / low > 1e4 ? [1] : [1, 2, 5];
    for (let decade = Math.floor(Math.log10(low)); decade <= Math.ceil(Math.log10(high)); decade++) {
      for (const each of steps) { const value = each * 10 ** decade; if (value >= low && value <= high) found.push(value); }
    }
    if (found.length > 1) return found;  // else its ends are so near to each other that even steps are as good
  }
  const least = (high - low) / 7, decade = 10 ** Math.floor(Math.log10(least));
  const step = [1, 2, 5, 10].map((each) => each * decade).find((each) => each >= least) || 10 * decade;
  const first = Math.ceil(low / step);
  return Array.from({ length: Math.floor(high / step) - first + 1 }, (_, i) => (first + i) * step);
}
// A canvas with its grid and names drawn: `values` are all that must fit between its ends, `marks` are told below it.
function axes(canvas, { span, inset, values, log, title, below, marks }) {
  const { pen, width, height } = sheet(canvas), left = 48, right = 14, bottom = 40, top = 24;
  let low = Math.min(...values), high = Math.max(...values);
  if (log) { low /= 1.25; high *= 1.25; } else { const room = 0.06 * (high - low) || 1; low -= room; high += room; }
  const x = (value) => left + inset + (width - left - right - 2 * inset) * (value - span[0]) / (span[1] - span[0]);
  const level = (value) => (log ? Math.log(Math.max(value, low)) : value), ends = [level(low), level(high)];
  const y = (value) => height - bottom - (height - bottom - top) * (level(value) - ends[0]) / (ends[1] - ends[0] || 1);
  pen.font = `12px ${FONT}`; pen.lineWidth = 1;
  for (const value of ticks(low, high, log)) {
    pen.strokeStyle = ink.faint; pen.beginPath(); pen.moveTo(left, y(value)); pen.lineTo(width - right, y(value)); pen.stroke();
    pen.fillStyle = ink.soft; pen.textAlign = "right"; pen.fillText(signed(`${Number(value.toPrecision(3))}`), left - 6, y(value) + 4);
  }
  pen.textAlign = "left"; pen.fillText(title, 4, 12);
  pen.textAlign = "center";
  const every = Math.max(1, Math.ceil(marks.length / Math.max(1, Math.floor((width - left) / 44))));
  marks.forEach((mark, i) => { if (i % every === 0) pen.fillText(signed(`${mark}`), x(mark), height - bottom + 18); });
  pen.fillText(below, (left + width - right) / 2, height - 6);
  return { pen, x, y, top, foot: height - bottom };
}
