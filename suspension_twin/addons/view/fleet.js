// SPDX-License-Identifier: Apache-2.0
// The list of a fleet: asked for every second, worst first where something is wrong.

const find = (id) => document.getElementById(id);
const said = find("said");

function show(text) {
  said.textContent = text;
  said.hidden = !text;
}

async function open(name) {
  show(`Opening the page of ${name} …`);
  // Opened at the click: a browser lets no page open another one later.
  const page = window.open("", name);
  const answer = await fetch("open", { method: "POST", body: name });
  if (!answer.ok) {
    page?.close();
    show(await answer.text());
    return;
  }
  const { port, token } = await answer.json();
  const place = new URL(location.href);
  place.port = port;
  place.search = token ? `?token=${token}` : "";
  show("");
  if (page) page.location = place.href;
  else location.href = place.href;
}

const rows = new Map();

function row(name) {
  if (rows.has(name)) return rows.get(name);
  const line = document.createElement("tr");
  const cells = Array.from({ length: 5 }, () => line.appendChild(document.createElement("td")));
  cells[0].textContent = name;
  const button = document.createElement("button");
  button.textContent = "Watch";
  button.addEventListener("click", () => open(name).catch((error) => show(String(error))));
  cells[4].append(button);
  find("twins").append(line);
  rows.set(name, { line, cells });
  return rows.get(name);
}

let known = [];

function draw(twins) {
  known = twins;
  const wanted = find("search").value.trim().toLowerCase();
  for (const twin of twins) {
    const { line, cells } = row(twin.name);
    cells[1].textContent = twin.rate ? `${twin.rate.toFixed(0)} Hz` : "–";
    cells[2].textContent = twin.gap || "–";
    cells[3].textContent = twin.text || (twin.rate ? "running" : "no samples yet");
    line.className = twin.failing ? "bad" : twin.text ? "warn" : "";
    line.hidden = Boolean(wanted) && !twin.name.toLowerCase().includes(wanted);
  }
  const with_samples = twins.filter((twin) => twin.rate).length;
  find("count").textContent = `${twins.length} twins, ${with_samples} with samples`;
}

async function ask() {
  try {
    const answer = await fetch("twins");
    draw(await answer.json());
    find("link").className = "dot ok";
  } catch {
    find("link").className = "dot bad";
  }
  setTimeout(ask, 1000);
}

find("search").addEventListener("input", () => draw(known));
ask();
