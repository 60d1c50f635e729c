// Measures the contrast of all text and controls on the page, as WCAG 2 counts it, and returns what has too little.
() => {
  const paint = new OffscreenCanvas(1, 1).getContext("2d", { willReadFrequently: true });
  // The browser itself mixes colours: whatever way they are written, and however transparent.
  const over = (...layers) => {
    paint.clearRect(0, 0, 1, 1);
    for (const layer of layers) {
      paint.fillStyle = layer;
      paint.fillRect(0, 0, 1, 1);
    }
    return [...paint.getImageData(0, 0, 1, 1).data].slice(0, 3);
  };
  const luminance = (rgb) => {
    const [red, green, blue] = rgb.map((it) => it / 255).map((it) => (it <= 0.04045 ? it / 12.92 : ((it + 0.055) / 1.055) ** 2.4));
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
  };
  const contrast = (one, other) => {
    const [low, high] = [luminance(one), luminance(other)].sort((a, b) => a - b);
    return (high + 0.05) / (low + 0.05);
  };
  const lineage = (element) => {
    const found = [];
    for (let it = element; it; it = it.parentElement) found.unshift(it);
    return found;
  };
  const behind = (elements) => ["white", ...elements.map((it) => getComputedStyle(it).backgroundColor)];
  const name = (element) => `${element.tagName.toLowerCase()}.${element.className} ${(element.textContent || element.ariaLabel || "").trim().slice(0, 40)}`;
  const poor = new Set();
  let texts = 0;
  let graphics = 0;

  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    if (!walker.currentNode.textContent.trim() || !element.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
    if (element.closest(".hidden, .skip, script")) continue;
    texts += 1;
    const elements = lineage(element);
    const opacity = elements.reduce((share, it) => share * Number(getComputedStyle(it).opacity), 1);
    const back = behind(elements);
    const colour = `rgb(${over(...back, getComputedStyle(element).color).join(" ")} / ${opacity})`;
    const ratio = contrast(over(...back, colour), over(...back));
    if (ratio < 4.5) poor.add(`text ${ratio.toFixed(2)} ${name(element)}`);
  }
  const check = (element, what, colour, back) => {
    graphics += 1;
    const ratio = contrast(over(...back, colour), over(...back));
    if (ratio < 3) poor.add(`${what} ${ratio.toFixed(2)} ${name(element)}`);
  };
  const seen = (selector) => [...document.querySelectorAll(selector)].filter((it) => it.checkVisibility());
  for (const it of seen("input:not([type=range]):not([type=radio]):not([type=checkbox]), select, textarea, meter")) {
    check(it, "border", getComputedStyle(it).borderTopColor, behind(lineage(it.parentElement)));
  }
  for (const it of seen(".dot, .task .state")) {
    const style = getComputedStyle(it);
    const filled = over("white", style.backgroundColor).join() !== over("white").join() || !Number.parseFloat(style.borderTopWidth);
    check(it, "dot", filled ? style.backgroundColor : style.borderTopColor, behind(lineage(it.parentElement)));
  }
  for (const it of seen(".spark path")) check(it, "line", getComputedStyle(it).stroke, behind(lineage(it.closest(".card"))));
  for (const it of seen(".card")) check(it, "edge", getComputedStyle(it).borderTopColor, behind([document.body]));
  for (const it of seen("#events li > button:first-child")) check(it, "edge", getComputedStyle(it).borderLeftColor, behind(lineage(it.closest(".panel"))));
  const panel = behind(lineage(document.querySelector(".stage")));
  for (const variable of ["--accent", "--bid", "--refused", "--move", "--warning", "--edge"]) {
    check(document.querySelector(".stage"), variable, getComputedStyle(document.body).getPropertyValue(variable), panel);
  }
  for (const [text, colour] of window.written ?? []) {
    texts += 1;
    const ratio = contrast(over(...panel, colour), over(...panel));
    if (ratio < 4.5) poor.add(`drawn ${ratio.toFixed(2)} ${text} ${colour}`);
  }
  return { poor: [...poor], texts, graphics, drawn: window.written?.size ?? 0 };
}
