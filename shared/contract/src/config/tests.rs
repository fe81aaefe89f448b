//! Tests that files written by earlier versions stay valid, and that a wrong value is refused with its line.
#![allow(clippy::unwrap_used)]

use super::*;

/// An `agent.toml` that an early version of the command `mission` wrote. The current version must write the same bytes.
const WRITTEN_BY_A_MISSION: &str = r#"device = "agent-1"
site = "mission-1795417316"
broker = "mqtt://127.0.0.1:42435"
data = "/missions/a/city"
out = "/missions/a/agents/agent-1"
views = ["0001.jpg", "0002.jpg"]
held_out = ["0000.jpg"]
eval_every = 8
steps = 1500
seed = 0
memory_bytes = 1073741824
threads = 1
color_only = false
exposure = false
alone = false
compress = false
flights_max = 256
wait_global = true
"#;

/// All fields but `serial` and `baud`, which exclude `broker`. Every value has the form in which [`AgentConfig`] writes it.
const ALL_FIELDS: &str = r#"device = "drone-1"
site = "quarry"
broker = "mqtts://broker.example.org:8883"
data = "data"
out = "out"
views = ["b.jpg"]
held_out = []
eval_every = 0
steps = 7
seed = 3
memory_bytes = 300000000
max_size_px = 320
compute = "gpu:1"
threads = 2
color_only = true
prune = 0.25
exposure = true
poses = "learn"
init = "global"
frame = "EPSG-2180"
key = "drone-1.key"
trusted = "trusted.txt"
alone = true
compress = false
flights_max = 300
wait_global = false

[tls]
ca = "ca.pem"
cert = "drone-1.pem"
key = "drone-1.key"
"#;

const USUAL: &str = "device = \"d\"\nsite = \"s\"\nbroker = \"b\"\ndata = \"in\"\nout = \"out\"\nsteps = 7\n";

fn refused(text: &str) -> String {
    AgentConfig::from_toml(text).unwrap_err().to_string()
}

#[test]
fn toml_written_before_is_written_again_byte_for_byte() {
    for text in [WRITTEN_BY_A_MISSION, ALL_FIELDS] {
        let config = AgentConfig::from_toml(text).unwrap();
        let now = text.replace("memory_bytes =", "memory =").replace("max_size_px =", "max_size =");
        assert_eq!(toml::to_string(&config).unwrap(), now);
    }
}

#[test]
fn site_and_broker_are_enough() {
    let config = AgentConfig::from_toml("site = \"s\"\nbroker = \"b\"\n").unwrap();
    assert_eq!((config.device, config.steps), (None, DEFAULT_STEPS));
    assert_eq!([config.data, config.out], ["data", "out"].map(PathBuf::from));
}

#[test]
fn most_fields_need_not_be_written() {
    let config = AgentConfig::from_toml(USUAL).unwrap();
    assert_eq!((config.steps, config.eval_every, config.seed), (7, 8, 0));
    assert!(config.views.is_empty() && config.memory_bytes.is_none() && !config.alone && !config.wait_global);
    assert_eq!(config.broker.as_ref().unwrap().port, 1883);
}

#[test]
fn json_is_read_back_as_it_was_written() {
    for text in [WRITTEN_BY_A_MISSION, ALL_FIELDS, USUAL] {
        let config = AgentConfig::from_toml(text).unwrap();
        let json = serde_json::to_string(&config).unwrap();
        assert_eq!(serde_json::from_str::<AgentConfig>(&json).unwrap(), config);
    }
}

#[test]
fn a_serial_port_takes_the_place_of_a_broker() {
    let text = USUAL.replace("broker = \"b\"", "serial = \"/dev/ttyUSB0\"");
    let config = AgentConfig::from_toml(&text).unwrap();
    assert_eq!(config.link(), Ok(AgentLink::Serial { port: "/dev/ttyUSB0", baud: DEFAULT_BAUD }));
}

#[test]
fn an_error_names_line_and_field_and_shows_the_line() {
    for (line, reason) in [
        ("device = \"a b\"", "line 1, device: ' ' in a name: use only A-Z a-z 0-9 _ -"),
        ("device = \"global\"", "line 1, device: the name `global` is reserved for the aggregator's models"),
        ("site = \"\"", "line 2, site: a name must not be empty"),
        (
            "broker = \"mqtt://u:p@h\"",
            "line 3, broker: broker address \"mqtt://u:p@h\": write mqtt://host:port",
        ),
        ("steps = -1", "line 6, steps: "),
        (
            "steps = \"many\"",
            "line 6, steps: invalid type: string \"many\", expected a whole number from 0 to 4294967295",
        ),
        ("alone = 1", "line 7, alone: invalid type: integer `1`, expected true or false"),
        ("tls = 1", "line 7, tls: invalid type: integer `1`, expected a table"),
        ("steps = 0", "line 6, steps: give a number from 1 to 4294967295"),
        ("memory = \"much\"", "line 7, memory: 'much' is not an amount of memory; write for example 300MiB"),
        ("memory = -1", "line 7, memory: invalid value: integer `-1`, expected an amount of memory"),
        ("max_size = 15", "line 7, max_size: give a number from 16 to 4294967295"),
        ("threads = 0", "line 7, threads: give a number from 1 to 1024"),
        ("threads = 1025", "line 7, threads: give a number from 1 to 1024"),
        ("compute = \"cuda\"", "line 7, compute: give auto, cpu, gpu or gpu:N"),
        ("prune = 1.0", "line 7, prune: give a number from 0 to below 1"),
        ("frame = \"a/b\"", "line 7, frame: '/' in a name"),
        ("baud = 0", "line 7, baud: invalid value: integer `0`, expected a whole number from 1"),
        ("views = [\n    \"a.jpg\",\n    7,\n]", "line 9, views: "),
        ("[tls]\nca = \"ca.pem\"\ncert = 7", "line 9, tls.cert: "),
        ("[tls]\ncert = \"c.pem\"", "line 7, tls: missing field `ca`"),
        ("tls = { cert = \"c\" }", "line 7, tls: missing field `ca`"),
        ("data = \"\"", "line 4, data: name a folder"),
        ("out = \"\"", "line 5, out: name a folder"),
        ("stesp = 7", "line 7, stesp: unknown field `stesp`"),
        ("steps 7", "line 6, steps: "),
    ] {
        let key = line.split([' ', '[', ']']).find(|word| !word.is_empty()).unwrap();
        let others = USUAL.lines().map(|other| if other.starts_with(key) { line } else { other });
        let mut text = others.collect::<Vec<_>>().join("\n") + "\n";
        if !text.contains(line) {
            text += line;
        }
        let error = refused(&text);
        assert!(error.starts_with(reason) && error.lines().count() == 3, "{error:?} is not {reason:?}");
    }
}

#[test]
fn no_agent_has_the_name_of_the_aggregator() {
    let error = refused(&USUAL.replace("\"d\"", "\"aggregator\""));
    assert!(error.starts_with("device = \"aggregator\" is the name of the aggregator: write"), "{error}");
    assert!(AgentConfig::from_toml(&USUAL.replace("\"d\"", "\"aggregator-2\"")).is_ok());
}

#[test]
fn the_line_of_a_wrong_value_is_shown_with_marks_below_it() {
    for (text, excerpt) in [
        (format!("{USUAL}threads = 1025  # all\n"), "  7 | threads = 1025  # all\n    |           ^^^^"),
        (format!("{USUAL}[tls]\n\tca\t= 7\ncert = \"a\""), "  8 | \tca\t= 7\n    | \t  \t  ^"),
        (USUAL.replace("\"s\"", "\"ż b\""), "  2 | site = \"ż b\"\n    |        ^^^^^"),
        (format!("{USUAL}steps 7"), "  7 | steps 7\n"),
    ] {
        let error = refused(&text);
        assert!(error.contains(excerpt), "{error}\n is not\n{excerpt}");
    }
}

#[test]
fn memory_is_written_as_on_command_lines() {
    for (line, bytes) in [
        ("memory = \"300MiB\"", 300 << 20),
        ("memory = 314_572_800", 300 << 20),
        ("memory_bytes = 314572800", 300 << 20),
        ("memory_bytes = \"0.3 GB\"", 300_000_000),
    ] {
        let config = AgentConfig::from_toml(&format!("{USUAL}{line}\n")).unwrap();
        assert_eq!(config.memory_bytes, Some(bytes), "{line}");
    }
    let twice = refused(&format!("{USUAL}memory = 1\nmemory_bytes = 1\n"));
    assert!(twice.contains("duplicate field `memory`"), "{twice}");
}

#[test]
fn a_missing_field_is_named() {
    assert_eq!(refused(&USUAL.replace("site = \"s\"\n", "")), "missing field `site`");
}

#[test]
fn fields_that_contradict_each_other_are_refused() {
    for text in [USUAL.replace("broker = \"b\"\n", ""), format!("{USUAL}serial = \"/dev/ttyUSB0\"\n")] {
        assert!(refused(&text).contains("either broker"), "{text}");
    }
    let baud = refused(&format!("{USUAL}baud = 9600\n"));
    assert!(baud.contains("remove it") && baud.contains("serial"), "{baud}");
    let serial = USUAL.replace("broker = \"b\"", "serial = \"/dev/ttyUSB0\"");
    let tls = refused(&format!("{serial}[tls]\nca = \"a\"\ncert = \"b\"\nkey = \"c\"\n"));
    assert!(tls.contains("remove it") && tls.contains("mqtts"), "{tls}");
    let password = refused(&format!("{serial}password_file = \"p\"\n"));
    assert!(password.contains("password_file") && password.contains("remove it"), "{password}");
    let with_baud = AgentConfig::from_toml(&format!("{serial}baud = 9600\n")).unwrap();
    assert_eq!(AgentConfig::from_toml(&toml::to_string(&with_baud).unwrap()).unwrap(), with_baud);
    let unsigned = refused(&format!("{USUAL}compress = true\ntrusted = \"list\"\n"));
    assert!(unsigned.contains("`compress`") && unsigned.contains("`fleet`"), "{unsigned}");
    let signed = format!("{USUAL}compress = true\ntrusted = \"list\"\nfleet = \"others\"\n");
    assert!(AgentConfig::from_toml(&signed).is_ok());
}
