//! The state of a site as OpenMetrics (openmetrics.io, version 1.0), for monitoring.

use std::fmt::Write;

use cosurf_contract::AgentStatus;

use super::state::{DeviceState, State};

/// The content type of the text.
pub(super) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// The text of all metrics.
pub(super) fn metrics(state: &State) -> String {
    let mut text = String::new();
    let flag = |value: bool| f64::from(u8::from(value));
    let mut whole = |name: &str, kind: &str, help: &str, value: f64| {
        let end = if kind == "counter" { "_total" } else { "" };
        let _ = writeln!(text, "# TYPE {name} {kind}\n# HELP {name} {help}\n{name}{end} {value}");
    };
    whole("cosurf_uptime_seconds", "gauge", "Time since the program began.", state.uptime_s);
    whole("cosurf_broker_connected", "gauge", "1 if the broker is reached.", flag(state.is_connected));
    whole("cosurf_events", "counter", "Events of the service.", state.events as f64);
    let revision = state.revision.as_ref().map_or(0, |newest| newest.revision);
    whole(
        "cosurf_revision",
        "gauge",
        "Newest revision of the global model; 0 before the first.",
        revision as f64,
    );
    by_device(&mut text, state, "kept_out", "1 if its model is kept out.", |its| {
        Some(flag(its.kept_out.is_some()))
    });
    by_device(&mut text, state, "heard_seconds", "Time since it was last heard.", |its| its.heard_s_ago);
    type Figure = (&'static str, &'static str, fn(&AgentStatus) -> f64);
    let figures: [Figure; 5] = [
        ("step", "Training steps done.", |status| f64::from(status.step)),
        ("splats", "Splats.", |status| status.splats as f64),
        ("memory_bytes", "Resident memory.", |status| status.memory_bytes as f64),
        ("sent_bytes", "Bytes of the upload so far.", |status| status.bytes_sent as f64),
        ("psnr_decibels", "PSNR of the training.", |status| status.psnr.map_or(f64::NAN, f64::from)),
    ];
    for (name, help, figure) in figures {
        by_device(&mut text, state, name, help, |its| {
            its.status.as_ref().map(figure).filter(|value| value.is_finite())
        });
    }
    text + "# EOF\n"
}

/// A gauge with a value for each device that has one. Names of devices have only letters, digits, `_` and `-`.
fn by_device(
    text: &mut String,
    state: &State,
    name: &str,
    help: &str,
    value: impl Fn(&DeviceState) -> Option<f64>,
) {
    let _ = writeln!(text, "# TYPE cosurf_device_{name} gauge\n# HELP cosurf_device_{name} {help}");
    for device in &state.devices {
        if let Some(value) = value(device) {
            let _ = writeln!(text, "cosurf_device_{name}{{device=\"{}\"}} {value}", device.device);
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::path::Path;

    use cosurf_wire::DeviceId;

    use super::super::board::Board;
    use super::*;

    #[test]
    fn the_metrics_have_a_line_for_each_device() {
        let board = Board::new(Path::new("no such folder"));
        let status = AgentStatus { step: 12, ..AgentStatus::new(300, "1") };
        board.note_status(DeviceId::new("drone-1").unwrap(), status);
        let text = metrics(&board.state());
        assert!(text.contains("\ncosurf_device_step{device=\"drone-1\"} 12\n"), "{text}");
        assert!(!text.contains("psnr_decibels{"), "an unknown figure has no line: {text}");
        assert!(text.contains("\ncosurf_events_total 0\n") && text.ends_with("# EOF\n"), "{text}");
    }
}
