// Checks that the page can draw a document: its tables are tables, and its lists are lists. The server checks everything else.

import {LISTS} from "./document.js";

const TABLES = ["pins", "units", "velocities"], NAMES = ["pins", "along", "between", "links", "of"], NUMBERS = ["teeth", "radii", "force", "centre"];

const isTable = value => typeof value === "object" && value !== null && !Array.isArray(value);
const isNames = value => Array.isArray(value) && value.every(name => typeof name === "string");

/** The reason why the page cannot draw a document; empty if it can. */
export function shapeProblem(document) {
  const table = TABLES.find(key => key in document && !isTable(document[key]));
  if (table) return `${table}: must be a table`;
  if ("ground" in document && !isNames(document.ground)) return "ground: must be a list of pins";
  for (const section of LISTS.filter(key => key in document)) {
    const entries = document[section];
    if (!Array.isArray(entries) || !entries.every(isTable)) return `${section}: must be a list of tables`;
    for (const [k, entry] of entries.entries()) {
      const problem = entryProblem(section, entry);
      if (problem) return `${section}[${k}].${problem}`;
    }
  }
  return "";
}

function entryProblem(section, entry) {
  if ("name" in entry && typeof entry.name !== "string") return "name: must be a string";
  if (section === "link" && !("pins" in entry)) return "pins: missing; a link needs a list of pins, such as [\"A\", \"B\"]";
  const names = NAMES.find(key => key in entry && !isNames(entry[key])), numbers = NUMBERS.find(key => key in entry && !Array.isArray(entry[key]));
  if (names) return `${names}: must be a list of names, such as A, B`;
  if ("outline" in entry && !Array.isArray(entry.outline) && typeof entry.outline !== "string" && !isTable(entry.outline)) return "outline: must be a list of corners, or the name of a DXF or SVG file";
  if (numbers) return `${numbers}: must be a list, such as [1, 2]`;
  if (!("profile" in entry)) return "";
  const isProfile = isTable(entry.profile) && ["angle", "radius", "law", "lift", "swing"].every(key => !(key in entry.profile) || Array.isArray(entry.profile[key]));
  return isProfile ? "" : "profile: angle, radius, law, lift and swing must be lists";
}
