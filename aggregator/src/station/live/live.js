// The page of a running site: follows the events of the server, shows them, and asks for the operator's actions.
//
// Start reading at listen.

/* global Rows, SiteMap, element, counted, seconds */

/** The server says every 5 s that it lives. After so long without a word, ms, the page says that it does not answer. */
const LOST_MS = 12000;
/** Pause before a connection that the browser has given up is made again, ms. */
const AGAIN_MS = 2000;
/** Largest number of lines of the log. */
const LINES_MAX = 300;

const at = (id) => document.getElementById(id);
const rows = new Rows(at('heads'), at('devices'));
const siteMap = new SiteMap(at('map'), at('place'));
/** The devices by name. */
const devices = new Map();
const shownRevision = Number(document.body.dataset.revision) || null;
let heardAt = Date.now();
/** What was set in the revision that the page showed before. */
const settings = history.state?.settings;
let mapOf = '';
/** The viewer, once it has the whole model. */
let viewer;
/** The newest revision when the older ones were listed. */
let revisionsOf = null;
let events;

/** Opens the stream of events. A browser reconnects by itself, unless the server refuses. */
function listen() {
  events?.close();
  events = new EventSource('/api/events');
  events.addEventListener('state', ({ data }) => show(JSON.parse(data)));
  events.addEventListener('alive', heard);
  events.addEventListener('error', () => {
    lose();
    if (events.readyState === EventSource.CLOSED) setTimeout(listen, AGAIN_MS);
  });
}

function heard() {
  heardAt = Date.now();
  at('lost').hidden = true;
}

function lose() {
  at('lost').textContent = 'The aggregator does not answer. What is shown may be old; this page tries to connect again.';
  at('lost').hidden = false;
}

/** Shows a state, or what has changed of it. */
function show(state) {
  heard();
  const { revision, merge, log } = state;
  if (state.is_whole) {
    devices.clear();
    at('log').replaceChildren();
  }
  for (const device of state.devices) {
    const ago = device.heard_s_ago;
    devices.set(device.device, { ...device, heardAt: ago === null ? null : Date.now() - 1000 * ago });
  }
  const parts = [state.is_connected ? 'connected to the broker' : 'not connected to the broker'];
  parts.push(revision ? `revision ${revision.revision}: ${counted(revision.splats, 'splat')} of ${counted(revision.models, 'model')}` : 'no global model');
  if (revision?.restored_from) parts.push(`it repeats revision ${revision.restored_from} until you merge`);
  if (merge) parts.push(`merging, step ${merge.step} of ${merge.steps}`);
  at('summary').textContent = parts.join(' · ');
  rows.show(devices);
  write(log);
  offer(revision);
  const names = [...devices.keys()].sort();
  choose(at('forget-device'), names, names.map(describeDevice));
  listRevisions(revision);
  drawMap();
}

/** Adds lines to the log, which stays at its end if it was there. */
function write(lines) {
  const list = at('log');
  const isAtEnd = list.scrollHeight - list.scrollTop - list.clientHeight < 20;
  list.append(...lines.map(({ at_s, text }) => element('li', `${seconds(at_s)}: ${text}`)));
  while (list.children.length > LINES_MAX) list.firstChild.remove();
  if (isAtEnd) list.scrollTop = list.scrollHeight;
}

/** Offers a newer revision than the page shows. The first one is shown at once, and one that was withdrawn no longer. */
function offer(revision) {
  const newest = revision?.revision ?? null;
  at('newer').hidden = !newest || newest === shownRevision;
  at('newer').textContent = `Show revision ${newest}`;
  if (newest !== shownRevision && !(newest && shownRevision)) location.reload();
}

/** Shows the newest revision, with what is set in this one. */
function showNewest() {
  if (viewer) history.replaceState({ settings: viewer.settings() }, '');
  location.reload();
}

/** Takes the viewer once it has the whole model, and sets in it what was set in the revision before. */
async function takeViewer() {
  history.replaceState(null, '');
  viewer = await globalThis.cosurf;
  if (settings) await viewer?.takeSettings(settings);
}

/** Lists choices, without losing the chosen one. `texts` tell what they are, if that is more than their names. */
function choose(list, names, texts = names) {
  const isListed = (name, i) => list.children[i].value === name && list.children[i].textContent === String(texts[i]);
  if (list.children.length === names.length && names.every(isListed)) return;
  const chosen = list.value;
  list.replaceChildren(...names.map((name, i) => Object.assign(element('option', texts[i]), { value: name })));
  if (names.includes(chosen)) list.value = chosen;
}

/** A device with what the operator has done to it. */
function describeDevice(name) {
  const { is_revoked: isRevoked, is_withdrawn: isWithdrawn } = devices.get(name);
  const done = [isRevoked && 'revoked', isWithdrawn && 'withdrawn'].filter(Boolean);
  return done.length ? `${name} (${done.join(', ')})` : name;
}

/** What a revision is, in the time of the browser's place. */
function describeRevision({ revision, made_s: made, models, splats, restored_from: from }) {
  const when = made && new Date(1000 * made).toLocaleString(undefined, { dateStyle: 'medium', timeStyle: 'short' });
  const parts = [revision, when, counted(models, 'model'), counted(splats, 'splat'), from && `repeats revision ${from}`];
  return parts.filter(Boolean).join(' · ');
}

/** Lists the revisions that can be restored once there is another newest one. */
async function listRevisions(revision) {
  const newest = revision?.revision ?? 0;
  if (at('actions').hidden || newest === revisionsOf) return;
  revisionsOf = newest;
  const answer = await fetch('/api/revisions').catch(() => null);
  if (!answer?.ok) return (revisionsOf = null);
  const old = await answer.json();
  choose(at('restore-revision'), old.map(({ revision: number }) => String(number)), old.map(describeRevision));
  at('restore').disabled = !at('restore-revision').value;
}

/** Draws the map again once other models have arrived. */
async function drawMap() {
  const models = [...devices.values()].map(({ device, model }) => `${device} ${model}`).sort().join();
  if (models === mapOf) return siteMap.tick(devices);
  mapOf = models;
  const answer = await fetch('/api/map').catch(() => null);
  if (!answer?.ok) return (mapOf = '');
  siteMap.show(await answer.json(), devices);
  const looking = await globalThis.cosurf;
  if (looking) siteMap.look(looking);
}

async function ask(path, body) {
  const options = { method: 'POST', body: body && JSON.stringify(body) };
  const answer = await fetch(path, options).catch(() => null);
  at('answer').textContent = !answer ? 'The aggregator does not answer.' : answer.ok ? 'Done.' : `Refused: ${await answer.text()}`;
}

at('actions').hidden = !document.body.dataset.acts;
at('newer').addEventListener('click', showNewest);
at('merge').addEventListener('click', () => ask('/api/merge'));
at('forget').addEventListener('click', () => {
  const device = at('forget-device').value;
  if (device && confirm(`Withdraw all models that ${device} has sent so far?`)) ask('/api/forget', { device });
});
at('revoke').addEventListener('click', () => {
  const [device, forget] = [at('forget-device').value, at('revoke-forget').checked];
  const more = forget ? ' Its models are withdrawn as well.' : '';
  if (device && confirm(`Refuse everything that ${device} sends from now on? Only the command revoke --undo lets it take part again.${more}`)) ask('/api/revoke', { device, forget });
});
at('restore').addEventListener('click', () => {
  const revision = Number(at('restore-revision').value);
  if (revision && confirm(`Make revision ${revision} the newest one? It stays until you merge; models that arrive until then are stored.`)) ask('/api/restore', { revision });
});
setInterval(() => {
  rows.tick(devices);
  siteMap.tick(devices);
  if (Date.now() - heardAt > LOST_MS) {
    lose();
    heardAt = Date.now();
    listen();
  }
}, 1000);
takeViewer();
listen();
