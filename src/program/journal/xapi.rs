//! A score as statements of the Experience API (xAPI) 1.0.3, for learning platforms.
//!
//! A platform gets who (`actor`) did what (`verb`) with which exercise (`object`), and the `result`. An exercise has one statement that it
//! is completed, with its figures as extensions, one for each of its phases, and one of its score. The same score gives the same bytes,
//! with the same IDs, so that a platform that gets a file twice keeps it once (specification, part two, 2.4.1 and part three, 2.1).
//! <https://github.com/adlnet/xAPI-Spec/blob/1.0.3/xAPI-Data.md>

use std::str::FromStr;

use palpate_refusal::{Reason, Refusal};
use ring::digest::{SHA1_FOR_LEGACY_USE_ONLY, digest};
use serde_json::{Map, Value, json};

use super::super::score::exercise::ScoredExercise;
use super::super::score::{Score, ScoredMeasure};
use super::output::utc;

/// The namespace of the statements' IDs: that of URLs, as their name begins with one (RFC 4122, appendix C).
const URL_NAMESPACE: [u8; 16] = 0x6ba7_b811_9dad_11d1_80b4_00c0_4fd4_30c8_u128.to_be_bytes();

/// An assessment: the type of an exercise and of its phases (vocabulary of ADL).
const ACTIVITY_TYPE: &str = "http://adlnet.gov/expapi/activities/assessment";

/// Who did an exercise, as a learning platform knows them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Actor {
    /// `mailto:` and an address.
    Mailbox(String),
    /// The home page of a system, and the name of an account there.
    Account { home_page: String, name: String },
}

impl FromStr for Actor {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        const FORM: &str = "must be mailto:NAME@HOST, or the home page of a system and the name of an account there: 'https://lms.example.org ada'";
        if let Some(address) = text.strip_prefix("mailto:") {
            let is_address = address.split('@').count() == 2 && address.split('@').all(|part| !part.is_empty());
            return if is_address && is_printed(address) { Ok(Actor::Mailbox(text.to_owned())) } else { Err(FORM) };
        }
        let (home_page, name) = text.split_once(' ').ok_or(FORM)?;
        let name = name.trim().to_owned();
        let home_page = WebAddress::from_str(home_page).map_err(|_| FORM)?.0;
        if name.is_empty() { Err(FORM) } else { Ok(Actor::Account { home_page, name }) }
    }
}

/// The beginning of the identifiers of exercises and measures: an address that you control.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct WebAddress(String);

impl FromStr for WebAddress {
    type Err = &'static str;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let rest = text.strip_prefix("https://").or_else(|| text.strip_prefix("http://"));
        match rest {
            Some(rest) if !rest.trim_matches('/').is_empty() && is_printed(rest) => {
                Ok(WebAddress(text.trim_end_matches('/').to_owned()))
            }
            _ => Err("must be an address that begins with https:// or http://, without spaces"),
        }
    }
}

/// Returns whether a text has only characters that an IRI may have (RFC 3987).
fn is_printed(text: &str) -> bool {
    text.chars().all(|c| !c.is_whitespace() && !c.is_control() && !"<>\"{}|\\^`".contains(c))
}

/// Whose score it is, and where its identifiers begin.
#[derive(clap::Args)]
pub(super) struct XapiOptions {
    /// Write xAPI 1.0.3 statements of the exercise to this file, JSON for a learning platform
    #[arg(long, value_name = "FILE", requires_all = ["actor", "xapi_base"])]
    pub(super) xapi: Option<std::path::PathBuf>,
    /// Who did the exercise: mailto:NAME@HOST, or the home page of a system and the name of an account there, 'https://lms.example.org ada'
    #[arg(long, value_name = "ACTOR", requires = "xapi")]
    actor: Option<Actor>,
    /// The name of the actor, for people
    #[arg(long, value_name = "NAME", requires = "xapi")]
    actor_name: Option<String>,
    /// An address of yours, with which the identifiers of exercises and measures begin, such as https://example.org/simulation
    #[arg(long, value_name = "URL", requires = "xapi")]
    xapi_base: Option<WebAddress>,
}

/// Returns the statements of the exercise of a score, a JSON array in the order of their times. Its recording began `began_unix_ns` after the
/// beginning of 1970; `has_ended` tells whether the exercise, and so its last phase, has.
///
/// # Errors
/// Refuses a score without an exercise.
pub(super) fn statements(
    score: &Score,
    options: &XapiOptions,
    began_unix_ns: u64,
    has_ended: bool,
) -> Result<Value, Refusal> {
    // The command line asks for both.
    let (Some(actor), Some(base)) = (&options.actor, &options.xapi_base) else { return Ok(Value::Array(Vec::new())) };
    let exercise = score.exercise.as_ref().ok_or_else(needs_exercise)?;
    let actor = agent(actor, options.actor_name.as_deref());
    let of = Statements { score, exercise, actor, base: &base.0, began_unix_ns, has_ended };
    let mut all: Vec<Value> = of.phases().collect();
    all.push(of.whole());
    all.extend(exercise.score_percent.map(|percent| of.scored(percent)));
    Ok(Value::Array(all))
}

/// Returns the refusal of statements without an exercise.
pub(super) fn needs_exercise() -> Refusal {
    let message = "needs an exercise: give --exercise, or a journal of a session that was made for one";
    Refusal::new(Reason::Missing, "--xapi", message)
}

fn agent(actor: &Actor, name: Option<&str>) -> Value {
    let mut agent = match actor {
        Actor::Mailbox(mbox) => json!({ "objectType": "Agent", "mbox": mbox }),
        Actor::Account { home_page, name } => {
            json!({ "objectType": "Agent", "account": { "homePage": home_page, "name": name } })
        }
    };
    if let (Some(name), Some(agent)) = (name, agent.as_object_mut()) {
        agent.insert("name".to_owned(), json!(name));
    }
    agent
}

struct Statements<'s> {
    score: &'s Score,
    exercise: &'s ScoredExercise,
    actor: Value,
    base: &'s str,
    began_unix_ns: u64,
    has_ended: bool,
}

impl Statements<'_> {
    fn activity(&self) -> String {
        format!("{}/exercises/{}", self.base, self.exercise.name)
    }

    /// Returns a statement that ends after the exercise's step `end`, counted from its beginning.
    fn statement(&self, verb: &str, [id, name]: [&str; 2], end: u64, result: Value) -> Value {
        let source = &self.score.source;
        // What tells one attempt from another.
        let session = (source.session_id.as_deref(), self.began_unix_ns, self.score.begin_step);
        let extensions = json!({
            format!("{}/scene", self.base): source.scene,
            format!("{}/changed-thresholds", self.base): self.exercise.changed_thresholds,
        });
        let mut statement = json!({
            "actor": self.actor,
            "verb": { "id": format!("http://adlnet.gov/expapi/verbs/{verb}"), "display": { "en": verb } },
            "object": {
                "objectType": "Activity",
                "id": id,
                "definition": { "type": ACTIVITY_TYPE, "name": { "en": name } },
            },
            "result": result,
            "context": { "platform": format!("Palpate {}", self.score.version), "extensions": extensions },
            "timestamp": self.timestamp(end),
        });
        // Another content has another ID: a platform refuses two contents with one.
        statement["id"] = json!(uuid(&format!("{id}\n{session:?}\n{statement}")));
        statement
    }

    /// Returns the time at which `steps` steps were done, UTC (ISO 8601).
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn timestamp(&self, steps: u64) -> String {
        // Saturating cast.
        let unix_ns = self.began_unix_ns.saturating_add((1e9 * self.seconds(steps)) as u64);
        utc(unix_ns).replace(' ', "T") + "Z"
    }

    #[allow(clippy::cast_precision_loss)]
    fn seconds(&self, steps: u64) -> f64 {
        steps as f64 / self.score.rate_hz
    }

    /// Returns the verb and the result of a part that took `steps` steps, with its figures of all tools together. A part that has not ended
    /// was attempted.
    fn result(&self, has_ended: bool, steps: u64, measures: &[ScoredMeasure]) -> (&'static str, Value) {
        let of_all = measures.iter().filter(|measure| measure.tool.is_none());
        let figure =
            |measure: &ScoredMeasure| (format!("{}/measures/{}", self.base, measure.name), json!(measure.value));
        let extensions: Map<String, Value> = of_all.map(figure).collect();
        let duration = format!("PT{:.2}S", self.seconds(steps));
        let result = json!({ "completion": has_ended, "duration": duration, "extensions": extensions });
        (if has_ended { "completed" } else { "attempted" }, result)
    }

    fn whole(&self) -> Value {
        let (activity, steps) = (self.activity(), self.score.steps);
        let (verb, result) = self.result(self.has_ended, steps, &self.score.measures);
        self.statement(verb, [&activity, &self.exercise.name], steps, result)
    }

    /// Returns the statement of the score, whose time is that of the end.
    fn scored(&self, percent: f64) -> Value {
        let score = json!({ "scaled": (percent / 100.0).clamp(0.0, 1.0), "raw": percent, "min": 0, "max": 100 });
        let activity = self.activity();
        self.statement("scored", [&activity, &self.exercise.name], self.score.steps, json!({ "score": score }))
    }

    fn phases(&self) -> impl Iterator<Item = Value> {
        self.exercise.phases.iter().zip(1..).map(|(phase, number)| {
            let has_ended = self.has_ended || number < self.exercise.phases.len();
            let id = format!("{}/phases/{number}", self.activity());
            let end = (phase.begin_step + phase.steps).saturating_sub(self.score.begin_step);
            let (verb, result) = self.result(has_ended, phase.steps, &phase.measures);
            let mut statement = self.statement(verb, [&id, &phase.title], end, result);
            statement["context"]["contextActivities"] = json!({ "parent": [{ "id": self.activity() }] });
            statement
        })
    }
}

/// Returns the UUID of a name (RFC 4122, version 5).
fn uuid(name: &str) -> String {
    let hash = digest(&SHA1_FOR_LEGACY_USE_ONLY, &[&URL_NAMESPACE, name.as_bytes()].concat());
    let mut bytes = [0; 16];
    bytes.iter_mut().zip(hash.as_ref()).for_each(|(byte, of_hash)| *byte = *of_hash);
    bytes[6] = bytes[6] & 0x0f | 0x50;
    bytes[8] = bytes[8] & 0x3f | 0x80;
    let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    [&hex[..8], &hex[8..12], &hex[12..16], &hex[16..20], &hex[20..]].join("-")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::super::score::exercise::ScoredPhase;
    use super::super::super::score::{ScoreSource, Thresholds};
    use super::*;

    fn measure(name: &str, value: f64, tool: Option<u32>) -> ScoredMeasure {
        ScoredMeasure { name: name.to_owned(), value, unit: "1".to_owned(), tool }
    }

    /// A session of 12.5 s in two phases.
    fn score() -> Score {
        let phase = |title: &str, begin_step: u64, steps: u64| ScoredPhase {
            title: title.to_owned(),
            begin_step,
            steps,
            measures: vec![measure("hits", 1.0, None), measure("peak_force_n", 2.0, Some(0))],
        };
        let exercise = ScoredExercise {
            name: "search-mark".to_owned(),
            seed: 7,
            changed_thresholds: Vec::new(),
            score_percent: Some(62.5),
            criteria: Vec::new(),
            phases: vec![phase("Search", 100, 10_000), phase("Mark", 10_100, 2_500)],
            lumps: Vec::new(),
            answers: Vec::new(),
        };
        let thresholds = Thresholds {
            force_limit_n: None,
            pressure_limit_pa: None,
            strain_limit: None,
            coverage_pa: 2000.0,
            press_n: 0.1,
            hands: Vec::new(),
            seen_along: None,
        };
        Score {
            version: "1.2.3".to_owned(),
            source: ScoreSource {
                scene: "phantom".to_owned(),
                session_id: Some("a1".to_owned()),
                ..ScoreSource::default()
            },
            rate_hz: 1000.0,
            begin_step: 100,
            steps: 12_500,
            thresholds,
            measures: vec![
                measure("hits_share", 0.5, None),
                measure("work_j", -0.25, None),
                measure("sparc", -3.0, Some(1)),
            ],
            limit_crossing_count: None,
            limit_crossings: Vec::new(),
            exercise: Some(exercise),
        }
    }

    fn told(score: &Score, actor: &str) -> Vec<Value> {
        let options = XapiOptions {
            xapi: None,
            actor: Some(actor.parse().unwrap()),
            actor_name: Some("Ada".to_owned()),
            xapi_base: Some("https://example.org/simulation/".parse().unwrap()),
        };
        // 2026-01-01 00:00:00.
        let all = statements(score, &options, 1_767_225_600_000_000_000, true).unwrap();
        all.as_array().unwrap().clone()
    }

    fn keys<'v>(value: &'v Value, known: &[&str], what: &str) -> Result<&'v Map<String, Value>, String> {
        let fields = value.as_object().ok_or(format!("{what} is no object"))?;
        match fields.keys().find(|key| !known.contains(&key.as_str())) {
            Some(key) => Err(format!("{what} has {key}")),
            None => Ok(fields),
        }
    }

    fn is_iri(value: &Value) -> bool {
        value.as_str().is_some_and(|text| {
            let scheme = text.split_once(':').map(|(scheme, _)| scheme);
            scheme.is_some_and(|scheme| scheme.starts_with(|c: char| c.is_ascii_alphabetic())) && is_printed(text)
        })
    }

    fn check(holds: bool, what: &str) -> Result<(), String> {
        if holds { Ok(()) } else { Err(what.to_owned()) }
    }

    fn language_map(value: &Value) -> Result<(), String> {
        let fields = value.as_object().ok_or("a language map is no object")?;
        check(fields.iter().all(|(tag, text)| tag.len() >= 2 && text.is_string()), "language map")
    }

    fn extensions(value: Option<&Value>) -> Result<(), String> {
        let Some(value) = value else { return Ok(()) };
        let fields = value.as_object().ok_or("extensions are no object")?;
        check(fields.keys().all(|key| is_iri(&Value::String(key.clone()))), "a key of an extension is no IRI")
    }

    /// Checks a statement by the rules of the specification, part two: 2.2 (formatting) and 2.4 (properties).
    fn valid(statement: &Value) -> Result<(), String> {
        let known = [
            "id",
            "actor",
            "verb",
            "object",
            "result",
            "context",
            "timestamp",
            "stored",
            "authority",
            "version",
            "attachments",
        ];
        let fields = keys(statement, &known, "a statement")?;
        // 2.2: no property is null, except in extensions.
        check(fields.values().all(|value| !value.is_null()), "null")?;
        let id = statement["id"].as_str().ok_or("no id")?;
        let parts: Vec<usize> = id.split('-').map(str::len).collect();
        let is_hex = id.chars().all(|c| c == '-' || c.is_ascii_hexdigit());
        check(
            parts == [8, 4, 4, 4, 12] && is_hex && id.as_bytes()[14] == b'5' && b"89ab".contains(&id.as_bytes()[19]),
            "id",
        )?;
        // 2.4.2: exactly one identifier.
        let actor = keys(
            &statement["actor"],
            &["objectType", "name", "mbox", "mbox_sha1sum", "openid", "account"],
            "the actor",
        )?;
        let identifiers =
            ["mbox", "mbox_sha1sum", "openid", "account"].iter().filter(|key| actor.contains_key(**key)).count();
        check(identifiers == 1, "an actor has one identifier")?;
        if let Some(mbox) = actor.get("mbox") {
            check(mbox.as_str().is_some_and(|mbox| mbox.starts_with("mailto:") && mbox.contains('@')), "mbox")?;
        }
        if let Some(account) = actor.get("account") {
            let account = keys(account, &["homePage", "name"], "the account")?;
            check(account.len() == 2 && is_iri(&account["homePage"]) && account["name"].is_string(), "account")?;
        }
        let verb = keys(&statement["verb"], &["id", "display"], "the verb")?;
        check(verb.get("id").is_some_and(is_iri), "verb")?;
        language_map(&statement["verb"]["display"])?;
        let object = keys(&statement["object"], &["objectType", "id", "definition"], "the object")?;
        check(object.get("id").is_some_and(is_iri), "object")?;
        keys(&object["definition"], &["name", "description", "type", "moreInfo", "extensions"], "the definition")?;
        check(is_iri(&object["definition"]["type"]), "type")?;
        language_map(&object["definition"]["name"])?;
        let result = keys(
            &statement["result"],
            &["score", "success", "completion", "response", "duration", "extensions"],
            "the result",
        )?;
        if let Some(score) = result.get("score") {
            let score = keys(score, &["scaled", "raw", "min", "max"], "the score")?;
            let number = |key: &str| score.get(key).and_then(Value::as_f64);
            check(number("scaled").is_none_or(|scaled| (-1.0..=1.0).contains(&scaled)), "scaled")?;
            let within = number("raw").zip(number("min")).zip(number("max"));
            check(within.is_none_or(|((raw, min), max)| min < max && (min..=max).contains(&raw)), "raw")?;
        }
        if let Some(duration) = result.get("duration") {
            let seconds = duration.as_str().and_then(|text| text.strip_prefix("PT")?.strip_suffix('S'));
            check(seconds.is_some_and(|text| text.parse::<f64>().is_ok_and(|s| s >= 0.0)), "duration")?;
        }
        check(result.get("completion").is_none_or(Value::is_boolean), "completion")?;
        extensions(result.get("extensions"))?;
        let context = keys(
            &statement["context"],
            &[
                "registration",
                "instructor",
                "team",
                "contextActivities",
                "revision",
                "platform",
                "language",
                "statement",
                "extensions",
            ],
            "the context",
        )?;
        extensions(context.get("extensions"))?;
        if let Some(activities) = context.get("contextActivities") {
            let kinds = keys(activities, &["parent", "grouping", "category", "other"], "contextActivities")?;
            let are_activities =
                |list: &Value| list.as_array().is_some_and(|list| list.iter().all(|one| is_iri(&one["id"])));
            check(kinds.values().all(are_activities), "contextActivities")?;
        }
        let timestamp = statement["timestamp"].as_str().ok_or("no timestamp")?;
        check(timestamp.len() == 24 && timestamp.as_bytes()[10] == b'T' && timestamp.ends_with('Z'), "timestamp")
    }

    #[test]
    fn statements_obey_the_rules_of_the_specification_and_the_rules_refuse_others() {
        let mut ids = std::collections::BTreeSet::new();
        for actor in ["mailto:ada@example.org", "https://lms.example.org ada"] {
            let all = told(&score(), actor);
            assert_eq!(all, told(&score(), actor));
            for statement in &all {
                valid(statement).unwrap_or_else(|why| panic!("{why}: {statement:#}"));
                assert!(ids.insert(statement["id"].as_str().unwrap().to_owned()), "{statement:#}");
            }
        }
        let good = told(&score(), "mailto:ada@example.org").pop().unwrap();
        for (pointer, wrong) in [
            ("/id", json!("a1")),
            ("/actor/mbox", json!("ada@example.org")),
            ("/actor", json!({ "name": "Ada" })),
            ("/verb/id", json!("scored")),
            ("/verb/display", json!("scored")),
            ("/object/id", json!("search mark")),
            ("/result/score/scaled", json!(62.5)),
            ("/result/score/raw", json!(162.5)),
            ("/result", json!({ "duration": "12.5 s" })),
            ("/result", json!({ "extensions": { "hits": 1 } })),
            ("/context", json!({ "seed": 7 })),
            ("/timestamp", json!("2026-01-01 00:00:00")),
            ("/result", Value::Null),
        ] {
            let mut statement = good.clone();
            *statement.pointer_mut(pointer).unwrap() = wrong.clone();
            assert!(valid(&statement).is_err(), "{pointer}: {wrong}");
        }
    }

    #[test]
    fn a_platform_is_told_each_phase_the_completion_and_the_score() {
        let all = told(&score(), "mailto:ada@example.org");
        let facts: Vec<_> = all
            .iter()
            .map(|one| {
                (
                    one["verb"]["display"]["en"].as_str().unwrap(),
                    one["object"]["id"].as_str().unwrap(),
                    one["timestamp"].as_str().unwrap(),
                )
            })
            .collect();
        let exercise = "https://example.org/simulation/exercises/search-mark";
        assert_eq!(
            facts,
            [
                ("completed", &*format!("{exercise}/phases/1"), "2026-01-01T00:00:10.000Z"),
                ("completed", &*format!("{exercise}/phases/2"), "2026-01-01T00:00:12.500Z"),
                ("completed", exercise, "2026-01-01T00:00:12.500Z"),
                ("scored", exercise, "2026-01-01T00:00:12.500Z"),
            ]
        );
        assert_eq!(all[3]["result"]["score"], json!({ "scaled": 0.625, "raw": 62.5, "min": 0, "max": 100 }));
        assert_eq!(
            (&all[0]["result"]["duration"], &all[2]["result"]["duration"]),
            (&json!("PT10.00S"), &json!("PT12.50S"))
        );
        // Figures of single tools are left out.
        let expected = json!({
            "https://example.org/simulation/measures/hits_share": 0.5,
            "https://example.org/simulation/measures/work_j": -0.25,
        });
        assert_eq!(all[2]["result"]["extensions"], expected);
        assert_eq!(all[0]["context"]["contextActivities"]["parent"][0]["id"], exercise);
        // As uuid5(NAMESPACE_URL, …) of Python.
        assert_eq!(uuid("https://example.org/"), "527dda32-a0de-5105-a042-cb475b5f7d11");
        let without = Score { exercise: None, ..score() };
        let options = XapiOptions {
            xapi: None,
            actor: Some("mailto:a@b".parse().unwrap()),
            actor_name: None,
            xapi_base: Some("https://example.org".parse().unwrap()),
        };
        assert_eq!(statements(&without, &options, 0, true).unwrap_err().field, "--xapi");
    }

    #[test]
    fn an_actor_is_a_mailbox_or_an_account() {
        let account = Actor::Account { home_page: "https://lms.example.org".to_owned(), name: "ada 7".to_owned() };
        assert_eq!("https://lms.example.org/ ada 7".parse(), Ok(account));
        for wrong in [
            "ada",
            "mailto:ada",
            "mailto:a@b c",
            "mailto:@b",
            "https://lms.example.org",
            "ftp://lms ada",
            "https:// ada",
        ] {
            assert!(wrong.parse::<Actor>().is_err(), "{wrong}");
        }
        for wrong in ["example.org", "https://", "https://example.org/a b", "urn:a"] {
            assert!(wrong.parse::<WebAddress>().is_err(), "{wrong}");
        }
    }
}
