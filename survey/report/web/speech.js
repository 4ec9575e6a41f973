// The language of a page that comes from a server: what the reader chose, else what the browser prefers.

import { spoken, use } from "./words.js";

export function wantedLanguage() {
  const kept = localStorage.getItem("language");
  return kept || (navigator.language.toLowerCase().startsWith("de") ? "de" : "en");
}

/** @param {string} wanted "en" or "de" */
export const speak = async (wanted) => use(wanted, await (await fetch(new URL(`${wanted}.json`, import.meta.url))).json());

/** The other language from now on. */
export async function changeLanguage() {
  const to = spoken() === "en" ? "de" : "en";
  localStorage.setItem("language", to);
  await speak(to);
}
