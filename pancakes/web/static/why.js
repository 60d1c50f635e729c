// Why an actuator was commanded: the chain of packets back to the sensor reading, with the time of each step.

import { colour, h } from "./words.js";

export async function why(link, dialog, agent) {
  const said = h("p.said", { role: "status" }, "listening to all packets for a moment …");
  const close = h("form", { method: "dialog" }, h("button", {}, "Close"));
  dialog.replaceChildren(h("h2", { id: "dialog-title" }, `Why does ${agent} move?`), said, close);
  dialog.showModal();
  const { ok, reason, result } = await link.ask("explain", { agent });
  if (!ok || !result) {
    said.textContent = ok ? `Nobody has commanded an actuator of ${agent} lately.` : reason;
    return;
  }
  const last = result.steps[result.steps.length - 1];
  said.textContent = `The newest command, and what led to it: ${last.at_ms.toFixed(1)} ms from the first cause to the command.`;
  close.before(chain(result.steps, last.at_ms), alike(result.alike));
}

function chain(steps, whole) {
  const list = h("ol.chain");
  steps.forEach((step, index) => {
    const row = h("li", {}, h("div.what", {}, h("b", {}, step.type), h("span", {}, ` ${step.source}`)), h("div.body.dim", {}, step.body));
    row.style.setProperty("--tint", colour(step.source.split("/")[0]));
    if (index < steps.length - 1) {
      const took = step.travel_ms + step.handling_ms;
      const bar = h("span.bar");
      bar.style.width = `${Math.min(100, Math.max(1, (100 * took) / Math.max(whole, 1e-6))).toFixed(1)}%`;
      const travel = step.travel_ms > 0.005 ? `${step.travel_ms.toFixed(2)} ms on its way, ` : "";
      row.append(h("div.took", {}, bar, h("span.figure", {}, `${travel}${step.handling_ms.toFixed(2)} ms until the next`)));
    }
    list.append(row);
  });
  return list;
}

function alike(figures) {
  return h(
    "p.dim",
    {},
    `Of ${figures.count} commands that came about like this, half took no more than ${figures.p50_ms.toFixed(2)} ms, ` +
      `nine of ten ${figures.p90_ms.toFixed(2)} ms, the longest ${figures.max_ms.toFixed(2)} ms.`,
  );
}
