//! Access control: a random word in the link gives the role, and each request's host and origin are checked.

use std::io::Read;
use std::net::SocketAddr;

/// What a link allows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Looks.
    Viewer,
    /// Looks and acts.
    Operator,
}

/// The words in the two links.
#[derive(Clone, PartialEq, Eq)]
pub struct Secrets {
    operator: String,
    viewer: String,
}

impl std::fmt::Debug for Secrets {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Secrets")
    }
}

impl Secrets {
    /// Two words of 128 random bits from the operating system.
    ///
    /// # Errors
    /// The system gives no random numbers.
    pub fn random() -> std::io::Result<Self> {
        let mut bytes = [0; 32];
        std::fs::File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        let word = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self {
            operator: word(&bytes[..16]),
            viewer: word(&bytes[16..]),
        })
    }

    /// The word of a role.
    pub fn word(&self, role: Role) -> &str {
        match role {
            Role::Operator => &self.operator,
            Role::Viewer => &self.viewer,
        }
    }

    /// The role of a word.
    pub fn role(&self, word: &str) -> Option<Role> {
        if same(word, &self.operator) {
            Some(Role::Operator)
        } else if same(word, &self.viewer) {
            Some(Role::Viewer)
        } else {
            None
        }
    }
}

/// Compares in constant time, so that the duration reveals nothing.
fn same(a: &str, b: &str) -> bool {
    a.len() == b.len()
        && a.bytes()
            .zip(b.bytes())
            .fold(0, |found, (a, b)| found | (a ^ b))
            == 0
}

/// Whether a request names this server as its host. A name that an attacker's page resolves to this machine is refused;
/// this machine's own names pass with any port, so that a tunnel to another port works.
pub(crate) fn is_our_host(host: &str, address: SocketAddr) -> bool {
    let name = match host.strip_prefix('[') {
        Some(rest) => rest.split(']').next().unwrap_or(""),
        None => host.rsplit_once(':').map_or(host, |(name, _)| name),
    };
    if name == "localhost" {
        return true;
    }
    let Ok(ip) = name.parse::<std::net::IpAddr>() else {
        return false;
    };
    // An IP address cannot be rebound; a server on all addresses accepts any.
    ip.is_loopback() || ip == address.ip() || address.ip().is_unspecified()
}

/// Whether a request comes from a page of this server: the origin is that of the host that it names.
pub(crate) fn is_our_origin(origin: &str, host: &str) -> bool {
    origin.strip_prefix("http://") == Some(host)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_word_opens_its_own_role_and_nothing_else_opens_any() {
        let secrets = Secrets::random().unwrap();
        assert_ne!(secrets.operator, secrets.viewer);
        assert_eq!(secrets.operator.len(), 32);
        assert_eq!(secrets.role(&secrets.operator), Some(Role::Operator));
        assert_eq!(secrets.role(&secrets.viewer), Some(Role::Viewer));
        assert_eq!(secrets.role(""), None);
        assert_eq!(secrets.role(&secrets.operator[1..]), None);
        assert_eq!(format!("{secrets:?}"), "Secrets");
    }

    #[test]
    fn a_foreign_name_or_origin_is_refused() {
        let loopback: SocketAddr = "127.0.0.1:8080".parse().unwrap();
        for host in [
            "127.0.0.1:8080",
            "localhost:9000",
            "[::1]:8080",
            "localhost",
        ] {
            assert!(is_our_host(host, loopback), "{host}");
        }
        for host in [
            "evil.example:8080",
            "10.0.0.7:8080",
            "",
            "localhost.evil.example",
        ] {
            assert!(!is_our_host(host, loopback), "{host}");
        }
        let everywhere: SocketAddr = "0.0.0.0:8080".parse().unwrap();
        assert!(is_our_host("10.0.0.7:8080", everywhere));
        assert!(!is_our_host("evil.example:8080", everywhere));
        assert!(is_our_origin("http://localhost:9000", "localhost:9000"));
        assert!(!is_our_origin("http://evil.example", "localhost:9000"));
        assert!(!is_our_origin("null", "localhost:9000"));
    }
}
