// Chooses colours that can be read: 4.5 to 1 against the background for text, as WCAG 2 counts it.

const TEXT = 4.6;

/** Returns the relative luminance of red, green and blue from 0 to 1. */
export function luminance([red, green, blue]) {
  const linear = (it) => (it <= 0.04045 ? it / 12.92 : ((it + 0.055) / 1.055) ** 2.4);
  return 0.2126 * linear(red) + 0.7152 * linear(green) + 0.0722 * linear(blue);
}

/** Returns the contrast of two colours, from 1 to 21. */
export function contrast(one, other) {
  const [low, high] = [luminance(one), luminance(other)].sort((a, b) => a - b);
  return (high + 0.05) / (low + 0.05);
}

function rgb(hue, saturation, lightness) {
  const swing = saturation * Math.min(lightness, 1 - lightness);
  return [0, 8, 4].map((shift) => {
    const k = (shift + hue / 30) % 12;
    return lightness - swing * Math.max(-1, Math.min(k - 3, 9 - k, 1));
  });
}

/** Returns the lightness in percent, nearest to `wanted`, at which a hue can be read on a background. */
export function readable(hue, saturation, wanted, background, least = TEXT) {
  const darker = luminance(background) > 0.3;
  for (let light = wanted; light > 0 && light < 100; light += darker ? -1 : 1) {
    if (contrast(rgb(hue, saturation / 100, light / 100), background) >= least) return light;
  }
  return darker ? 0 : 100;
}
