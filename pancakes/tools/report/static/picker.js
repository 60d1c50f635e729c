// The picker of a report: a person picks a command and sees its chain. The data are in the page.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("commands-data").textContent);
  const find = (id) => document.getElementById(id);
  const [box, pen] = [find("picker"), find("picker-plot").getContext("2d")];
  const [choice, slider, when, chain, said] = ["picker-actuator", "picker-slider", "picker-when", "picker-chain", "picker-said"].map(find);
  const LIGHT = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#8c6d31", "#7f7f7f"];
  const DARK = ["#56b4e9", "#e69f00", "#2ec99e", "#e79ac6", "#0099ee", "#ff7a1a", "#c2a05a", "#a8a8a8"];
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  const EDGE = 60;
  let actuator = null;
  let place = 0;
  let rank = -1;
  let byTime = [];

  const sum = (values) => values.reduce((total, value) => total + value, 0);
  const latencyUs = (row) => sum(row[4]) + sum(row[5]);
  const caused = (row) => row[3].length > 1;
  const ms = (us) => `${Number((us / 1000).toPrecision(3))} ms`;
  const colour = (kind) => (dark.matches ? DARK : LIGHT)[kind % LIGHT.length];

  function element(name, text = "", className = "") {
    const made = document.createElement(name);
    made.textContent = text;
    if (className) made.className = className;
    return made;
  }

  function choose(number) {
    actuator = data.actuators[number];
    byTime = actuator.commands;
    slider.max = byTime.length - 1;
    const some = byTime.length < actuator.count;
    find("picker-left-out").textContent = some
      ? `${actuator.count.toLocaleString("en")} commands; of these ${byTime.length.toLocaleString("en")} can be picked: one of ${actuator.stride}, and the slowest. ` +
        `Any other: pancakes why FILE --agent ${actuator.agent} --type ${actuator.type} --time TIME`
      : `${actuator.count.toLocaleString("en")} commands, all of which can be picked.`;
    pick(Math.min(place, byTime.length - 1));
  }

  function pick(number) {
    place = Math.max(0, Math.min(byTime.length - 1, number));
    const row = byTime[place];
    slider.value = place;
    slider.setAttribute("aria-valuetext", `${(row[0] / 1000).toFixed(3)} s of mission time`);
    if (document.activeElement !== when) when.value = (row[0] / 1000).toFixed(3);
    const names = data.kinds[row[2]].map((number) => data.names[number]);
    const whole = latencyUs(row);
    said.textContent =
      `Command ${place + 1} of ${byTime.length}, at ${(row[0] / 1000).toFixed(3)} s: ${data.texts[row[1]]}. ` +
      (caused(row) ? `${ms(whole)} from the first cause to the command.` : "It answers no packet that was recorded.");
    chain.replaceChildren();
    let atUs = 0;
    names.forEach((name, step) => {
      const line = element("tr");
      const last = step === names.length - 1;
      line.append(element("td", ms(atUs), "n"), element("td", `${name} #${row[3][step]}`));
      if (last) {
        line.append(element("td", "", "n"), element("td", "", "n"), element("td"));
      } else {
        const [travel, handling] = [row[4][step], row[5][step]];
        const bar = element("td", "", "bar");
        for (const [className, us] of [["skip", atUs], ["travel", travel], ["handling", handling]]) {
          const part = element("i", "", className);
          part.style.width = `${whole ? (100 * us) / whole : 0}%`;
          bar.append(part);
        }
        line.append(element("td", ms(travel), "n"), element("td", ms(handling), "n"), bar);
        atUs += travel + handling;
      }
      chain.append(line);
    });
    alike(row);
    draw();
  }

  /** Shows the distribution of all commands with the same kind of chain, not only of those that can be picked. */
  function alike(row) {
    const found = caused(row) && data.distributions[row[2]];
    find("picker-alike").textContent = found
      ? `Of ${found.count.toLocaleString("en")} that came about like this: p50 ${found.p50}, p90 ${found.p90}, p99 ${found.p99}, longest ${found.max}.`
      : "";
  }

  // The plot ----------------------------------------------------------------------------------------------------

  function scale() {
    const canvas = pen.canvas;
    const { clientWidth: width, clientHeight: height } = canvas;
    const [from, to] = [byTime[0][0], byTime[byTime.length - 1][0]];
    const most = Math.max(1, ...byTime.map(latencyUs)) * 1.08;
    return {
      width, height, from, to, most,
      x: (msec) => EDGE + ((msec - from) / Math.max(1, to - from)) * (width - EDGE - 10),
      y: (us) => height - 24 - (us / most) * (height - 34),
    };
  }

  function draw() {
    const canvas = pen.canvas;
    const at = scale();
    if (!at.width) return;
    const ratio = window.devicePixelRatio || 1;
    canvas.width = at.width * ratio;
    canvas.height = at.height * ratio;
    pen.scale(ratio, ratio);
    const style = getComputedStyle(canvas);
    const [ink, faint, line] = ["--ink", "--faint", "--line"].map((name) => style.getPropertyValue(name));
    pen.font = "12px system-ui, sans-serif";
    pen.fillStyle = faint;
    pen.strokeStyle = line;
    for (let step = 0; step <= 2; step += 1) {
      const us = (at.most * step) / 2.16;
      pen.beginPath();
      pen.moveTo(EDGE, at.y(us));
      pen.lineTo(at.width - 10, at.y(us));
      pen.stroke();
      pen.textAlign = "right";
      pen.fillText(ms(us), EDGE - 6, at.y(us) + 4);
    }
    const steps = at.width > 600 ? 5 : 2;
    for (let step = 0; step <= steps; step += 1) {
      const msec = at.from + ((at.to - at.from) * step) / steps;
      pen.textAlign = step === 0 ? "left" : step === steps ? "right" : "center";
      pen.fillText(`${(msec / 1000).toFixed(1)} s`, at.x(msec), at.height - 6);
    }
    for (const row of byTime) {
      pen.fillStyle = caused(row) ? colour(row[2]) : faint;
      pen.fillRect(at.x(row[0]) - 1, at.y(latencyUs(row)) - 1, 2.5, 2.5);
    }
    const row = byTime[place];
    pen.strokeStyle = ink;
    pen.beginPath();
    pen.moveTo(at.x(row[0]), 4);
    pen.lineTo(at.x(row[0]), at.height - 22);
    pen.stroke();
    pen.lineWidth = 2;
    pen.beginPath();
    pen.arc(at.x(row[0]), at.y(latencyUs(row)), 6, 0, 7);
    pen.stroke();
  }

  pen.canvas.addEventListener("click", (event) => {
    const at = scale();
    let best = [Infinity, 0];
    byTime.forEach((row, number) => {
      const far = Math.hypot(at.x(row[0]) - event.offsetX, at.y(latencyUs(row)) - event.offsetY);
      if (far < best[0]) best = [far, number];
    });
    pick(best[1]);
  });

  // What a person does ------------------------------------------------------------------------------------------

  data.actuators.forEach((it, number) => choice.append(new Option(`${it.agent} ${it.type}`, String(number))));
  choice.addEventListener("change", () => choose(Number(choice.value)));
  slider.addEventListener("input", () => pick(Number(slider.value)));
  when.addEventListener("change", () => {
    // The command that was in force then: the newest that is not later.
    const msec = Math.round(Number(when.value) * 1000);
    let found = 0;
    byTime.forEach((row, number) => row[0] <= msec && (found = number));
    pick(found);
    when.value = (byTime[place][0] / 1000).toFixed(3);
  });
  find("picker-before").addEventListener("click", () => pick(place - 1));
  find("picker-after").addEventListener("click", () => pick(place + 1));
  find("picker-slowest").addEventListener("click", () => {
    const order = byTime.map((_, number) => number).sort((a, b) => latencyUs(byTime[b]) - latencyUs(byTime[a]) || a - b);
    // Another click picks the next slowest.
    rank = order[rank] === place ? (rank + 1) % order.length : 0;
    pick(order[rank]);
  });
  window.addEventListener("resize", draw);
  // What is folded away has no size.
  box.closest("details")?.addEventListener("toggle", () => actuator && draw());
  dark.addEventListener("change", draw);
  box.hidden = false;
  if (data.actuators.length) choose(0);
})();
