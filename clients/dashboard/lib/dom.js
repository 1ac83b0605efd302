/** Builds the page from elements, without a framework. Text is always set as text, never as
 * markup. */

const SVG = 'http://www.w3.org/2000/svg';

function setAttributes(element, attributes) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === undefined || value === null || value === false) continue;
    // The page's policy forbids the attribute, and the browser drops it: use a class instead.
    if (name === 'style') throw new Error("The page's policy forbids the style attribute.");
    if (name.startsWith('on')) element.addEventListener(name.slice(2), value);
    else if (name === 'value' || name === 'checked') element[name] = value;
    else element.setAttribute(name, value === true ? '' : String(value));
  }
}

function appendAll(element, children) {
  for (const child of children.flat(Infinity)) {
    if (child === undefined || child === null || child === false) continue;
    element.append(child instanceof Node ? child : document.createTextNode(String(child)));
  }
}

/**
 * Creates an element. Attributes whose name begins with "on" are listeners; those that are
 * undefined, null or false are left out.
 *
 * @param {string} tag "div", or "div.panel.wide" with classes
 * @param {Object<string, any>} [attributes]
 * @param {...any} children nodes, texts, numbers, or arrays of them
 * @returns {any} the element; any, so that its own members can be used without a cast
 */
export function h(tag, attributes = {}, ...children) {
  const [name, ...classes] = tag.split('.');
  const element = document.createElement(name);
  if (classes.length) element.className = classes.join(' ');
  setAttributes(element, attributes);
  appendAll(element, children);
  return element;
}

/** Creates an SVG element. */
export function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS(SVG, tag);
  setAttributes(element, attributes);
  appendAll(element, children);
  return element;
}

/** Replaces all children of an element. */
export function fill(element, ...children) {
  element.replaceChildren();
  appendAll(element, children);
  return element;
}

/** Sets a text in place. If the text is the same, nothing changes, so a selection in it stays. */
export function say(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Returns whether an element is in use: it has the focus, or is being pressed. */
export const isInUse = (element) => element.matches(':focus-within, :active');

/**
 * Shows a list in place. Each item has one element, made once and found again by its key, so that a
 * refresh interrupts neither focus, nor input, nor a press. An element in use does not even move:
 * the others move around it.
 * @template T
 * @param {Element} parent has only the elements of the list
 * @param {T[]} list
 * @param {function(T): string|number} key
 * @param {function(T): Element} make
 * @param {function(any, T): void} [update] updates an element from its item, including a new one
 */
export function patch(parent, list, key, make, update = () => {}) {
  /** @type {Map<string, Element>} */
  const before = parents.get(parent) ?? new Map();
  const now = new Map();
  for (const item of list) {
    const name = String(key(item));
    const element = before.get(name) ?? make(item);
    now.set(name, element);
    update(element, item);
  }
  parents.set(parent, now);
  const kept = new Set(now.values());
  for (const child of [...parent.childNodes]) {
    if (!kept.has(/** @type {Element} */ (child))) child.remove();
  }
  let at = parent.firstElementChild;
  for (const element of kept) {
    if (element !== at && isInUse(element)) {
      while (at !== element) {
        const next = at.nextElementSibling;
        parent.append(at);
        at = next;
      }
    }
    if (element === at) at = at.nextElementSibling;
    else parent.insertBefore(element, at);
  }
}
const parents = new WeakMap();

/** Updates the cells of a row. Cells that are equal stay, so their listeners may use only the
 * key. */
export function patchRow(row, cells) {
  [...cells].forEach((cell, i) => {
    const own = row.cells[i];
    if (!own) row.append(cell);
    else if (own.outerHTML !== cell.outerHTML) own.replaceWith(cell);
  });
}

/** Returns a button with a text that describes its action. */
export function button(text, onclick, attributes = {}) {
  return h('button', { type: 'button', onclick, ...attributes }, text);
}

/** Returns a button that stays pressed: aria-pressed is its state. */
export function toggle(text, pressed, onchange, attributes = {}) {
  const element = button(text, () => {
    const now = element.getAttribute('aria-pressed') !== 'true';
    element.setAttribute('aria-pressed', String(now));
    onchange(now);
  }, { 'aria-pressed': String(pressed), ...attributes });
  return element;
}

/** Returns a list of choices, which are texts or [value, text], without a visible name. */
export const choice = (label, choices, value, onchange) =>
  h('select', { 'aria-label': label, onchange: (event) => onchange(event.target.value) },
    choices.map((one) => {
      const [key, text] = Array.isArray(one) ? one : [one, one];
      return h('option', { value: key, selected: key === value }, text);
    }));

/** Returns the same, with its name above it. */
export const select = (label, choices, value, onchange) => h('label.field', {},
  h('span', {}, label), choice(label, choices, value, onchange));

/** Returns a table with its head. isRight(name, position): whether a column is right-aligned, as
 * numbers are. */
export function table(names, body, isRight = (name, i) => false, tag = 'table.cards') {
  return h(tag, {}, h('thead', {}, h('tr', {}, names.map((name, i) =>
    h(isRight(name, i) ? 'th.right' : 'th', { scope: 'col' }, name)))), body);
}

/** Returns a value with its name above it and words below. */
export function tile(name, value, words) {
  return h('div.panel.tile', {}, h('div.muted', {}, name), h('div.value', {}, value),
    h('div.muted', {}, words));
}

/** Explains a color in a legend. color: the name of a CSS custom property, or a color. */
export function swatch(color, kind = '') {
  const element = h(`i.swatch${kind}`);
  element.style.color = color.startsWith('--') ? `var(${color})` : color;
  return element;
}

/**
 * Prepares a canvas to be redrawn at its current size, or returns null if it has no size. color:
 * returns the color of such a name.
 */
export function paint(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas;
  if (!width || !height) return null;
  canvas.width = Math.round(width * devicePixelRatio);
  canvas.height = Math.round(height * devicePixelRatio);
  // Drawn by the CPU: charts change rarely, and the first use of a graphics processor takes a long
  // time.
  const context = canvas.getContext('2d', { willReadFrequently: true });
  context.scale(devicePixelRatio, devicePixelRatio);
  const style = getComputedStyle(canvas);
  context.font = `12px ${style.fontFamily}`;
  const color = (name) => (name.startsWith('--') ? style.getPropertyValue(name).trim() : name);
  return { context, width, height, color };
}

/** A note is shown for this long; a refusal until it is closed, or until the next page. */
const TOAST_MS = 6000;
let toastEnds;

/**
 * Shows in one line what happened or was refused, above any dialog; screen readers read it.
 */
export function announce(text, { isRefusal = false } = {}) {
  /** @type {any} */ // popovers are newer than the types
  const toast = document.getElementById('toast');
  clearTimeout(toastEnds);
  toast.classList.toggle('refusal', isRefusal);
  toast.firstElementChild.textContent = text;
  if (toast.matches('[data-open]')) toast.hidePopover?.();
  toast.toggleAttribute('data-open', Boolean(text));
  if (!text) return;
  toast.showPopover?.();
  if (!isRefusal) toastEnds = setTimeout(() => announce(''), TOAST_MS);
}
