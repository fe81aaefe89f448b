// The table of devices: a row for each, which is kept and changed in place. All texts from devices are set as text, never
// as markup.
//
// Start reading at Rows.show.

/* exported Rows, element, svg, counted, seconds, isAlive */

const COLUMNS = ['device', 'phase', 'step', 'PSNR', 'splats', 'memory', 'sent', 'left', 'heard', 'model', 'remarks'];
/** Agents tell how far they are every 5 s; one that is silent for so long has missed two. */
const SILENT_S = 15;

const element = (name, text, kind) => {
  const made = document.createElement(name);
  made.textContent = text;
  if (kind) made.className = kind;
  return made;
};
const svg = (name, attributes) => {
  const made = document.createElementNS('http://www.w3.org/2000/svg', name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
};
/** A number with a noun, in the plural unless it is one. */
const counted = (count, noun) => `${count} ${noun}${count === 1 ? '' : 's'}`;
const bytes = (count) => (count >= 1e6 ? `${(count / 1e6).toFixed(1)} MB` : `${Math.round(count / 1e3)} kB`);
const seconds = (s) => (s >= 5400 ? `${Math.round(s / 3600)} h` : s >= 120 ? `${Math.round(s / 60)} min` : `${Math.round(s)} s`);
/** Seconds since a device was heard; null if it was not. */
const heardAgo = ({ heardAt }) => (heardAt === null ? null : (Date.now() - heardAt) / 1000);
const isAlive = (device) => device.heardAt !== null && heardAgo(device) < SILENT_S && !['done', 'failed'].includes(device.status?.phase);

/** The style of a device's row. */
const kindOf = (device) => (isAlive(device) && !device.is_withdrawn ? '' : 'silent');

/** A bar with a text over it. */
function bar(cell, label, value, max, text) {
  const made = document.createElement('progress');
  [made.value, made.max] = [Math.min(value, max), Math.max(max, 1)];
  made.setAttribute('aria-label', label);
  cell.replaceChildren(text, made);
}

/** The training curve of a device. */
function curve(cell, points, text) {
  cell.replaceChildren(text);
  if (points.length < 2) return;
  const [[first], [last]] = [points[0], points.at(-1)];
  const low = Math.min(...points.map(([, psnr]) => psnr));
  const high = Math.max(...points.map(([, psnr]) => psnr), low + 1);
  const at = ([step, psnr]) => `${(100 * (step - first)) / Math.max(1, last - first)},${29 - (28 * (psnr - low)) / (high - low)}`;
  const chart = svg('svg', { class: 'curve', viewBox: '0 0 100 30', preserveAspectRatio: 'none', role: 'img' });
  chart.setAttribute('aria-label', `PSNR from ${low.toFixed(1)} dB at step ${first} to ${points.at(-1)[1].toFixed(1)} dB at step ${last}`);
  chart.append(svg('polyline', { points: points.map(at).join(' ') }));
  cell.append(chart);
}

class Rows {
  constructor(heads, body) {
    heads.append(...COLUMNS.map((name) => Object.assign(element('th', name), { scope: 'col' })));
    [this.body, this.rows] = [body, new Map()];
  }

  /** Shows devices, in order of their names. */
  show(devices) {
    const names = [...devices.keys()].sort();
    names.forEach((name, index) => {
      if (!this.rows.has(name)) this.rows.set(name, this.made(name));
      const row = this.rows.get(name);
      if (this.body.children[index] !== row.row) this.body.insertBefore(row.row, this.body.children[index] ?? null);
      this.fill(row, devices.get(name));
    });
    for (const [name, { row }] of this.rows) {
      if (devices.has(name)) continue;
      row.remove();
      this.rows.delete(name);
    }
  }

  made(name) {
    const row = document.createElement('tr');
    const cells = Object.fromEntries(COLUMNS.map((column) => [column, element('td', '–', column === 'remarks' ? 'remarks' : '')]));
    const dot = element('span', '', 'dot');
    cells.device.replaceChildren(dot, name);
    row.append(...Object.values(cells));
    return { row, cells, dot };
  }

  fill({ row, cells, dot }, device) {
    const { status, curve: points, model, kept_out: keptOut, is_revoked: isRevoked, is_withdrawn: isWithdrawn } = device;
    dot.style.background = device.color;
    row.className = kindOf(device);
    this.age({ cells }, device);
    cells.model.textContent = model ?? '–';
    cells.remarks.textContent = [isRevoked && 'revoked', isWithdrawn && 'withdrawn', keptOut && `kept out: ${keptOut}`, status?.problem].filter(Boolean).join('; ');
    cells.remarks.className = cells.remarks.textContent ? 'remarks warn' : 'remarks';
    if (!status) return;
    cells.phase.textContent = status.phase;
    bar(cells.step, 'Training', status.step, status.steps, `${status.step} of ${status.steps}`);
    curve(cells.PSNR, points, status.psnr === null ? '–' : `${status.psnr.toFixed(1)} dB`);
    cells.splats.textContent = status.splats;
    cells.memory.textContent = status.memory_bytes ? bytes(status.memory_bytes) : '–';
    const share = Math.min(100, Math.round((100 * status.bytes_arrived) / status.bytes_total));
    if (status.bytes_total) bar(cells.sent, 'Upload', share, 100, `${share} % of ${bytes(status.bytes_total)}`);
    cells.left.textContent = status.seconds_left === null ? '–' : seconds(status.seconds_left);
  }

  age({ cells }, device) {
    const ago = heardAgo(device);
    cells.heard.textContent = ago === null ? '–' : `${seconds(Math.max(0, ago))} ago`;
  }

  /** Counts the seconds since devices were heard. */
  tick(devices) {
    for (const [name, row] of this.rows) {
      const device = devices.get(name);
      if (!device) continue;
      this.age(row, device);
      row.row.className = kindOf(device);
    }
  }
}
