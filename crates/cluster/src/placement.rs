//! Placement of a session: the node with the most room takes it, and another node stands by for it.

use std::collections::BTreeMap;

use xxhash_rust::xxh3::xxh3_64;

use super::key::NodeValue;

/// Returns the name of the node that takes the next session: the one with the least load in whole percent, among
/// equals the one with the fewest sessions per thread, and among those the first by name. Draining nodes are skipped;
/// `None` if no node is left. `nodes` has the present nodes by name.
#[allow(clippy::cast_precision_loss)]
pub fn roomiest(nodes: &BTreeMap<String, NodeValue>) -> Option<&str> {
    // Loads are measured: smaller differences do not count.
    let load = |node: &NodeValue| (node.load * 100.0).round();
    let sessions = |node: &NodeValue| f64::from(node.sessions) / f64::from(node.threads.max(1));
    let taking = nodes.iter().filter(|(_, node)| !node.draining);
    taking
        .min_by(|(_, a), (_, b)| load(a).total_cmp(&load(b)).then(sessions(a).total_cmp(&sessions(b))))
        .map(|(name, _)| name.as_str())
}

/// Returns the name of the node that stands by for the session `session_id` of `owner`, by rendezvous hashing (Thaler
/// and Ravishankar 1998) over the other nodes in `nodes` that replay with the same bits and are not draining. When a
/// node joins or leaves, only the sessions that it stands by for change their standby. `None` if `owner` is not in
/// `nodes` or no node qualifies.
pub fn standby<'n>(session_id: &str, owner: &str, nodes: &'n BTreeMap<String, NodeValue>) -> Option<&'n str> {
    let replays = nodes.get(owner)?.replays;
    let others = nodes.iter().filter(|(name, node)| *name != owner && node.replays == replays && !node.draining);
    others.map(|(name, _)| name.as_str()).max_by_key(|name| xxh3_64(format!("{session_id} {name}").as_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(load: f64, sessions: u32) -> NodeValue {
        NodeValue {
            endpoint: String::new(),
            instance: String::new(),
            version: String::new(),
            replays: 1,
            threads: 1,
            load,
            sessions,
            draining: false,
        }
    }

    fn fleet(nodes: &[(&str, NodeValue)]) -> BTreeMap<String, NodeValue> {
        nodes.iter().map(|(name, node)| ((*name).to_owned(), node.clone())).collect()
    }

    #[test]
    fn the_node_with_the_most_room_takes_a_session() {
        let mut nodes = fleet(&[("a", node(0.5, 1)), ("b", node(0.2, 9)), ("c", node(0.2, 8))]);
        assert_eq!(roomiest(&nodes), Some("c"));
        nodes.get_mut("c").unwrap().draining = true;
        assert_eq!(roomiest(&nodes), Some("b"));
        nodes.values_mut().for_each(|node| node.draining = true);
        assert_eq!(roomiest(&nodes), None);
    }

    #[test]
    fn a_node_that_goes_changes_the_standby_of_its_own_sessions_only() {
        let nodes = fleet(&[("a", node(0.0, 0)), ("b", node(0.0, 0)), ("c", node(0.0, 0)), ("d", node(0.0, 0))]);
        let mut without = nodes.clone();
        without.remove("c");
        let mut counts = BTreeMap::new();
        for index in 0..3000 {
            let id = format!("{index:032x}");
            let before = standby(&id, "a", &nodes).unwrap();
            *counts.entry(before).or_insert(0) += 1;
            let after = standby(&id, "a", &without).unwrap();
            assert!(before == "c" || before == after);
            assert_ne!(after, "c");
        }
        assert!(counts.len() == 3 && counts.values().all(|count| (900..1100).contains(count)), "{counts:?}");
    }

    #[test]
    fn no_node_of_other_bits_stands_by() {
        let mut nodes = fleet(&[("a", node(0.0, 0)), ("b", node(0.0, 0))]);
        assert_eq!(standby("s", "a", &nodes), Some("b"));
        nodes.get_mut("b").unwrap().replays = 2;
        assert_eq!(standby("s", "a", &nodes), None);
        assert_eq!(standby("s", "unknown", &nodes), None);
    }
}
