// The named numbers of a drawing, of which other numbers are expressions, as fields.

import {namesIn} from "./expressions.js";
import {numbersOf, tidy} from "./units.js";
import {readValue, valueText} from "./values.js";

const NAME = /^[A-Za-zÀ-ɏα-ω_][\wÀ-ɏα-ω]*$/;

/** A field for each named number, and one to add the next. An emptied field removes its number. */
export function numberFields(panel) {
  const {document} = panel.studio, given = document.numbers ?? {}, values = numbersOf(document);
  const put = numbers => {
    const {numbers: _, ...rest} = document;
    panel.set(Object.keys(numbers).length ? {...rest, numbers} : rest);
  };
  const take = name => text => {
    const {[name]: _, ...others} = given, value = readValue(text);
    if (value !== undefined) return put({...given, [name]: value});
    const users = usersOf(document, name);
    return users.length ? panel.refuse(`${name} is used by ${users.join(", ")}`) : put(others);
  };
  const add = text => {
    const [name, value] = text.split("=").map(part => part.trim());
    if (!text) return undefined;
    if (!NAME.test(name) || !value) return panel.refuse(`"${text}" is not a number with a name: write r = 40`);
    if (namesIn(name).length === 0) return panel.refuse(`${name} has a meaning in expressions already: choose another name`);
    return put({...given, [name]: readValue(value)});
  };
  const unit = (name, value) => (typeof value === "string" && name in values ? `= ${tidy(+values[name].toPrecision(6))}` : "");
  return [...Object.entries(given).map(([name, value]) => panel.field(name, valueText(value), unit(name, value), take(name))),
    panel.field("new number", "", "", add, "r = 40, then lengths may be 2*r")];
}

/** The users of a named number: pins, elements and other numbers. */
function usersOf(document, name) {
  const uses = value => (typeof value === "string" ? namesIn(value).includes(name) : typeof value === "object" && value !== null && Object.entries(value).some(([key, x]) => !["name", "from", "to", "on", "line", "pins", "pin"].includes(key) && uses(x)));
  const {numbers = {}, pins = {}, ...rest} = document;
  const entries = Object.values(rest).filter(Array.isArray).flatMap(list => list.filter(x => typeof x === "object" && uses(x)).map(x => x.name ?? "an element"));
  return [...Object.keys(numbers).filter(other => other !== name && uses(numbers[other])), ...Object.keys(pins).filter(pin => uses(pins[pin])).map(pin => `pin ${pin}`), ...entries];
}
