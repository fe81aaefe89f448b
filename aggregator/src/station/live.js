// The page of a running site: shows the state that the server sends, and asks for the operator's actions. All texts from
// devices are set as text, never as markup.
//
// Start reading at show.

'use strict';
(() => {
  const at = (id) => document.getElementById(id);
  const COLUMNS = ['device', 'phase', 'step', 'PSNR', 'splats', 'memory', 'sent', 'left', 'heard', 'model', 'remarks'];
  let shownRevision = Number(document.body.dataset.revision) || null;
  let heardAt = 0;

  const element = (name, text, kind) => {
    const made = document.createElement(name);
    made.textContent = text;
    if (kind) made.className = kind;
    return made;
  };
  const bytes = (count) => (count >= 1e6 ? `${(count / 1e6).toFixed(1)} MB` : `${Math.round(count / 1e3)} kB`);
  const seconds = (s) => (s >= 120 ? `${Math.round(s / 60)} min` : `${Math.round(s)} s`);

  function cells({ device, status, heard_s_ago: heard, model, kept_out: keptOut }) {
    const of = (value, text) => (value === null || value === undefined ? '–' : text(value));
    const remarks = [keptOut && `kept out: ${keptOut}`, status?.problem].filter(Boolean).join('; ');
    return [
      device,
      of(status, ({ phase }) => phase),
      of(status, ({ step, steps }) => `${step} of ${steps}`),
      of(status?.psnr, (psnr) => `${psnr.toFixed(1)} dB`),
      of(status, ({ splats }) => String(splats)),
      of(status?.memory_bytes || null, bytes),
      of(status?.bytes_total || null, (total) => `${Math.min(100, Math.round((100 * status.bytes_sent) / total))} %`),
      of(status?.seconds_left, seconds),
      of(heard, (s) => `${seconds(s)} ago`),
      of(model, String),
      remarks,
    ];
  }

  function show(state) {
    heardAt = Date.now();
    const { revision, merge, devices, log } = state;
    const parts = [state.is_connected ? 'connected to the broker' : 'not connected to the broker'];
    parts.push(revision ? `revision ${revision.revision}: ${revision.splats} splats of ${revision.models} models` : 'no global model yet');
    if (merge) parts.push(`merging, step ${merge.step} of ${merge.steps}`);
    at('summary').textContent = parts.join(' · ');
    at('devices').replaceChildren(
      ...devices.map((device) => {
        const row = document.createElement('tr');
        row.append(...cells(device).map((text, i) => element('td', text, i === COLUMNS.length - 1 ? 'warn' : '')));
        return row;
      }),
    );
    const list = at('log');
    const isAtEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 20;
    list.replaceChildren(...log.map(({ at_s, text }) => element('li', `${seconds(at_s)}: ${text}`)));
    if (isAtEnd) list.scrollTop = list.scrollHeight;
    at('forget-device').replaceChildren(...devices.map(({ device }) => element('option', device)));
    if (revision && revision.revision !== shownRevision) {
      if (!shownRevision) location.reload();
      at('newer').hidden = false;
      at('newer').textContent = `Show revision ${revision.revision}`;
      shownRevision = revision.revision;
    }
  }

  async function ask(path, body) {
    const answer = await fetch(path, { method: 'POST', body: body && JSON.stringify(body) });
    at('answer').textContent = answer.ok ? 'Done.' : `Refused: ${await answer.text()}`;
  }

  at('actions').hidden = !document.body.dataset.acts;
  at('heads').append(...COLUMNS.map((name) => element('th', name)));
  at('newer').addEventListener('click', () => location.reload());
  at('forget').addEventListener('click', () => {
    const device = at('forget-device').value;
    if (device && confirm(`Withdraw all models that ${device} has sent so far?`)) ask('/api/forget', { device });
  });
  const events = new EventSource('/api/events');
  events.addEventListener('state', ({ data }) => show(JSON.parse(data)));
  events.addEventListener('error', () => {
    at('summary').textContent = 'The aggregator does not answer; trying again.';
  });
  setInterval(() => {
    if (heardAt && Date.now() - heardAt > 60000) fetch('/api/state').then((answer) => answer.json()).then(show, () => {});
  }, 5000);
})();
